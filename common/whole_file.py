"""Small files that are there whole or not at all."""

import os
from pathlib import Path


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that is on the disk before it has its name. The temporary one beside it has a dot in front.

    Raises OSError.
    """
    temporary = path.with_name(f".{path.name}")
    write_synced(temporary, content)
    temporary.rename(path)


def write_synced(path: Path, content: bytes) -> None:
    """Write a file, and wait until it is on the disk. Raises OSError."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
