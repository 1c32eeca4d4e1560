"""What a diagnosis says: what it is, by how much, and the option that changes it."""

from dataclasses import dataclass


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
