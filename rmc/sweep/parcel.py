"""What a run's folder has that another copy of it lacks, to be sent there. The replay ring is never in it."""

import io
import tarfile
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

Stamps = dict[str, tuple[int, int]]  # a file's size and time of change in ns, by its path in the folder


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
        for path in sorted(folder.rglob("*")):
            name = path.relative_to(folder)
            if name.parts[0] == "replay" or path.is_symlink():
                continue
            with suppress(FileNotFoundError):
                if path.is_dir():
                    folders.append(str(name))
                elif path.is_file():
                    about = path.stat()
                    stamp = about.st_size, about.st_mtime_ns
                    if stamps.get(str(name)) != stamp:
                        tar.add(path, str(name))
                    now[str(name)] = stamp
    return Parcel(folders, now, content.getvalue())


def unpack(parcel: Parcel, folder: Path, before: Stamps) -> None:
    """Make a copy like the folder that was packed. Of what is not in that, only what came ``before`` is removed."""
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    with tarfile.open(fileobj=io.BytesIO(parcel.tar)) as tar:
        tar.extractall(folder, filter="data")
    for name in parcel.folders:
        (folder / name).mkdir(parents=True, exist_ok=True)
    for name in before.keys() - parcel.stamps.keys():
        (folder / name).unlink(missing_ok=True)
        with suppress(OSError):  # other files are in it
            (folder / name).parent.rmdir()
