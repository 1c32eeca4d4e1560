"""A pickle that does something where it is read as code."""

import io
from pathlib import Path
from typing import Any

import torch


class Touch:
    """Makes a file when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.mark,)


def hostile_state(mark: Path) -> bytes:
    """As ``torch.save`` writes it; who loads it with trust makes the file."""
    file = io.BytesIO()
    torch.save({"agent": Touch(mark)}, file)
    return file.getvalue()
