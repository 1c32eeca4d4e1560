"""What a run's folder has that another copy of it lacks, to be sent there. The replay ring is never in it."""

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from rmc.common.whole_file import written_whole
from rmc.deploy.run.folder import RING

Stamps = dict[str, tuple[int, int]]  # a file's size and time of change in ns, by its path in the folder


@dataclass(frozen=True)
class Parcel:
    """Changed files, each with its mode and content, and the names of all."""

    folders: list[str] = field(default_factory=list)
    stamps: Stamps = field(default_factory=dict)
    files: dict[str, tuple[int, bytes]] = field(default_factory=dict, repr=False)

    @property
    def bytes(self) -> int:
        """Of its files."""
        return sum(len(content) for _, content in self.files.values())


def pack(folder: Path, stamps: Stamps) -> Parcel:
    """All that is not as in ``stamps``. Files that vanish meanwhile are left out."""
    parcel = Parcel()
    for path in _sent(folder):
        name = str(path.relative_to(folder))
        with suppress(FileNotFoundError):
            if path.is_dir():
                parcel.folders.append(name)
            elif path.is_file():
                about = path.stat()
                stamp = about.st_size, about.st_mtime_ns
                if stamps.get(name) != stamp:
                    parcel.files[name] = about.st_mode & 0o777, path.read_bytes()
                parcel.stamps[name] = stamp
    return parcel


def _sent(folder: Path) -> Iterator[Path]:
    """What is below it, but for rings, links, and its lock, which is of that machine."""
    for place, folders, files in os.walk(folder):  # which leaves out what vanishes
        if Path(place) == folder:
            folders[:] = [name for name in folders if not RING.fullmatch(name)]
        for path in (Path(place) / name for name in sorted((*folders, *files))):
            if not (path.is_symlink() or path == folder / ".lock"):
                yield path


def unpack(parcel: Parcel, folder: Path, before: Stamps) -> None:
    """Make a copy like the folder that was packed. Of what is not in that, only what came ``before`` is removed."""
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    for name in parcel.folders:
        (folder / name).mkdir(parents=True, exist_ok=True)
    for name, (mode, content) in parcel.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with written_whole(folder / name) as temporary:  # a kill leaves the one before
            temporary.write_bytes(content)
            temporary.chmod(mode)
            changed = parcel.stamps[name][1]
            os.utime(temporary, ns=(changed, changed))  # where it goes on, it is as it was here
    for name in before.keys() - parcel.stamps.keys():
        (folder / name).unlink(missing_ok=True)
        with suppress(OSError):  # other files are in it
            (folder / name).parent.rmdir()
