"""Files that are there whole or not at all. The temporary one beside each has a dot in front."""

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

NO_ROOM = {errno.ENOSPC, errno.EDQUOT}  # what a full disk raises


def write_whole(path: Path, content: bytes) -> None:
    """Write a small file that is on the disk before it has its name. Raises OSError."""
    temporary = temporary_path(path)
    write_synced(temporary, content)
    temporary.rename(path)


def write_private(path: Path, content: bytes) -> None:
    """As ``write_whole``, a file that only its owner may read, beside others who write it. Raises OSError."""
    with private_temporary(path) as temporary:
        write_synced(temporary, content)
        temporary.rename(path)


@contextmanager
def private_temporary(path: Path) -> Iterator[Path]:
    """A new file beside it that only its owner may read; after that it is removed, if it has this name still."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)  # mode 0600
    os.close(handle)
    try:
        yield Path(name)
    finally:
        Path(name).unlink(missing_ok=True)


def temporary_path(path: Path) -> Path:
    """Where a file is until it is whole."""
    return path.with_name(f".{path.name}")


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Where to write a file, which has its name after that; on an error it is removed."""
    temporary = temporary_path(path)
    try:
        yield temporary
        temporary.rename(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_synced(path: Path, content: bytes) -> None:
    """Write a file, and wait until it is on the disk. Raises OSError."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
