"""What a diagnosis says: what it is, by how much, and the option that changes it."""

from dataclasses import dataclass
from math import ceil


@dataclass(frozen=True)
class Finding:
    """One of ``rmc doctor``'s lines."""

    name: str
    """Like ``learner-bound``."""
    measured: str
    """By how much, from the records."""
    advice: str
    """What to change."""

    def __str__(self) -> str:
        return f"{self.name}: {self.measured}; {self.advice}"


def typed_number(value: float) -> int:
    """A number that is at least that and short to type: two digits, then zeros."""
    unit: int = 10 ** max(0, len(str(ceil(value))) - 2)
    return ceil(value / unit) * unit
