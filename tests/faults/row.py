"""A row of ``tests/faults/results.json``: what a fault's script found when it was run at length."""

import dataclasses
import json
import subprocess
import sys
import time
from pathlib import Path

RESULTS = Path(__file__).parent / "results.json"


@dataclasses.dataclass(frozen=True)
class Row:
    """What one script found. Counts of windows, seconds."""

    fault: str
    tries: int
    passed: bool
    acknowledged: int | None = None
    lost: int | None = None
    duplicated: int | None = None
    recovery_s_max: float | None = None
    found: dict[str, float | int | str] = dataclasses.field(default_factory=dict)
    """What else it measured."""

    def keep(self) -> None:
        """Put it into the file, in the place of an earlier one of the same fault; ends the script."""
        rows = json.loads(RESULTS.read_text()) if RESULTS.exists() else []
        kept = [row for row in rows if row["fault"] != self.fault]
        words = [Path(word).stem if word.endswith(".py") else word for word in sys.argv]
        command = f"python -m tests.faults.{' '.join(words)}"
        made = {
            "command": command,
            "date": time.strftime("%Y-%m-%d"),
            "commit": _commit(),
        }
        rows = sorted([*kept, dataclasses.asdict(self) | made], key=lambda row: str(row["fault"]))
        RESULTS.write_text(json.dumps(rows, indent=1) + "\n")
        print(json.dumps(dataclasses.asdict(self)))
        sys.exit(0 if self.passed else 1)


def _commit() -> str:
    git = ["git", "-C", str(RESULTS.parent), "describe", "--always", "--abbrev=7", "--dirty=+", "--exclude=*"]
    return subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
