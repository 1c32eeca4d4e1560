"""What a run's folder has that another copy of it lacks, to be sent there. The replay ring is never in it."""

import io
import os
import tarfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from rmc.deploy.run.folder import RING

Stamps = dict[str, tuple[int, int]]  # a file's size and time of change in ms, by its path in the folder
NS_PER_MS = 1_000_000  # finer times do not survive the tar


@dataclass(frozen=True)
class Parcel:
    """Changed files, and the names of all."""

    folders: list[str]
    stamps: Stamps
    tar: bytes = field(repr=False)


def pack(folder: Path, stamps: Stamps) -> Parcel:
    """All that is not as in ``stamps``. Files that vanish meanwhile are left out."""
    content, now, folders = io.BytesIO(), Stamps(), list[str]()
    with tarfile.open(fileobj=content, mode="w") as tar:
        for path in _sent(folder):
            name = str(path.relative_to(folder))
            with suppress(FileNotFoundError):
                if path.is_dir():
                    folders.append(name)
                elif path.is_file():
                    about = path.stat()
                    stamp = about.st_size, about.st_mtime_ns // NS_PER_MS
                    if stamps.get(name) != stamp:
                        tar.add(path, name)
                    now[name] = stamp
    return Parcel(folders, now, content.getvalue())


def _sent(folder: Path) -> Iterator[Path]:
    """What is below it, but for rings, links, and the lock of who trains there: that process is not here."""
    for place, folders, files in os.walk(folder):  # which leaves out what vanishes
        if Path(place) == folder:
            folders[:] = [name for name in folders if not RING.fullmatch(name)]
        for path in (Path(place) / name for name in sorted((*folders, *files))):
            if not (path.is_symlink() or (path == folder / ".lock" and _trains(path))):
                yield path


def _trains(lock: Path) -> bool:
    with suppress(FileNotFoundError):
        return lock.read_bytes().startswith(b"training")
    return False


def unpack(parcel: Parcel, folder: Path, before: Stamps) -> None:
    """Make a copy like the folder that was packed. Of what is not in that, only what came ``before`` is removed."""
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    with tarfile.open(fileobj=io.BytesIO(parcel.tar)) as tar:
        if hasattr(tarfile, "data_filter"):
            tar.extractall(folder, filter="data")
        else:  # before Python 3.11.4: what ``pack`` writes
            tar.extractall(
                folder, [one for one in tar if one.isfile() and {"/", ".."}.isdisjoint(Path(one.name).parts)]
            )
    for name in parcel.folders:
        (folder / name).mkdir(parents=True, exist_ok=True)
    for name in before.keys() - parcel.stamps.keys():
        (folder / name).unlink(missing_ok=True)
        with suppress(OSError):  # other files are in it
            (folder / name).parent.rmdir()
