"""One run of a sweep."""

import hashlib
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rmc.common.env.config import write_kwargs

TRIAL = "trial-"  # how the names of a search's runs begin
LONGEST_NAME = 120  # of 255 that a file system takes


@dataclass(frozen=True)
class Job:
    """``rmc`` with these words, in a folder of its own."""

    folder: Path
    words: tuple[str, ...]  # without --run-dir, which a cluster's node has a place of its own for
    seed: int
    values: dict[str, Any] = field(default_factory=dict)  # that tell it from the sweep's other runs, but for the seed

    @property
    def name(self) -> str:
        """The folder's."""
        return self.folder.name

    @property
    def is_trial(self) -> bool:
        """Of a search."""
        return self.name.startswith(TRIAL)

    @property
    def title(self) -> str:
        """What it is, for a line."""
        last = self.name if self.is_trial else f"seed {self.seed}"
        return ", ".join([*(f"{name} {value_text(value)}" for name, value in self.values.items()), last])

    @property
    def log(self) -> Path:
        """What it said."""
        return self.folder.parent / "logs" / f"{self.name}.log"

    def command(self, folder: Path) -> list[str]:
        """The words of ``rmc`` that train it in a folder."""
        return [*self.words, "--run-dir", str(folder)]


def value_text(value: Any) -> str:
    """A value in a table and in a name."""
    if isinstance(value, list | dict):
        return "x".join(map(str, value)) if isinstance(value, list) else " ".join(write_kwargs(value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def run_name(values: dict[str, Any], seed: int) -> str:
    """The folder's name of a grid's run."""
    whole = ",".join(f"{name}={value_text(value)}" for name, value in {**values, "seed": seed}.items())
    plain = re.sub(r"[^\w.,=+-]", "-", whole)
    if plain == whole and len(plain) <= LONGEST_NAME:
        return plain
    return f"{plain[:LONGEST_NAME]}-{hashlib.sha256(whole.encode()).hexdigest()[:8]}"
