"""A row of ``tests/faults/results.json``: what a fault's script found when it was run at length."""

import argparse
import dataclasses
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Self

from tests.faults.judge import Judgement

RESULTS = Path(__file__).parent / "results.json"
Found = Mapping[str, float | int | str]


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
    found: Found = dataclasses.field(default_factory=dict)
    """What else it measured."""

    @classmethod
    def judged(
        cls, fault: str, tries: int, passed: bool, verdict: Judgement, slowest: float, found: Found | None = None
    ) -> Self:
        """Of a run that has ended; ``slowest``: seconds until all went on. Passed where its ring is sound, too."""
        return cls(fault, tries, passed, recovery_s_max=round(slowest, 2), found=found or {}).with_verdict(verdict)

    def with_verdict(self, verdict: Judgement) -> Self:
        """The same with what its ring holds."""
        counts = {"acknowledged": verdict.acknowledged, "lost": verdict.lost, "duplicated": verdict.duplicated}
        return dataclasses.replace(self, passed=self.passed and verdict.sound, **counts)

    def keep(self) -> None:
        """Put it into the file, in the place of an earlier one of the same fault."""
        rows = json.loads(RESULTS.read_text()) if RESULTS.exists() else []
        kept = [row for row in rows if row["fault"] != self.fault]
        words = [Path(sys.argv[0]).stem, *sys.argv[1:]]
        about = {
            "command": f"python -m tests.faults.{' '.join(words)}",
            "date": time.strftime("%Y-%m-%d"),
            "commit": _commit(),
        }
        rows = sorted([*kept, dataclasses.asdict(self) | about], key=lambda row: str(row["fault"]))
        RESULTS.write_text(json.dumps(rows, indent=1) + "\n")
        print(json.dumps(dataclasses.asdict(self)), flush=True)


def at_length(doc: str | None, fault: Callable[..., Iterator[Row]], **numbers: int) -> None:
    """A script: ``fault`` in a folder of its own, with these numbers or its options; ends with 1 if a row failed."""
    parser = argparse.ArgumentParser(description=doc)
    for name, default in numbers.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    options, passed = vars(parser.parse_args()), True
    with tempfile.TemporaryDirectory(prefix="rmc-fault-") as place:
        for row in fault(folder=Path(place), **options):
            row.keep()
            passed = passed and row.passed
    sys.exit(0 if passed else 1)


def _commit() -> str:
    git = ["git", "-C", str(RESULTS.parent), "describe", "--always", "--abbrev=7", "--dirty=+", "--exclude=*"]
    return subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
