"""A Ray actor that holds one whole run on its node."""

import os
import shutil
import signal
import tempfile
import time
from pathlib import Path

from rmc.common.process.file_lock import take_lock
from rmc.deploy.ray.node import leave_rays_worker, private_folder
from rmc.sweep.local_runs import spawn
from rmc.sweep.parcel import Parcel, Stamps, pack, unpack

BEGIN_SECONDS = 60.0


class NodeRun:
    """``rmc train`` in a folder of the node that goes with it. Ends with the sweep."""

    def __init__(self, words: tuple[str, ...], home: Path, brought: Parcel, working_folder: str) -> None:
        """``home`` is the run's folder on the machine of the sweep, as its log calls it."""
        leave_rays_worker(working_folder)
        base = private_folder(Path(tempfile.gettempdir()) / f"rmc-sweep-{os.getuid()}")
        for folder in filter(_is_abandoned, base.iterdir()):
            shutil.rmtree(folder, ignore_errors=True)
        self._place = Path(tempfile.mkdtemp(dir=base))
        self._lock = take_lock(self._place / "lock")
        self._home, self._folder, self._log = home, self._place / home.name, self._place / "log"
        if brought.stamps:
            unpack(brought, self._folder, {})
        self._process = spawn([*words, "--run-dir", str(self._folder)], self._log)

    def look(self, stamps: Stamps, copy: bool) -> tuple[int | None, Parcel | None, bytes]:
        """The run's exit status, if it has one; where that is so, or a ``copy`` is due, what has changed, and its log.

        After its end, nothing is kept here.
        """
        status = self._process.poll()
        if status is None and not copy:
            return None, None, b""
        log = self._log.read_bytes().replace(os.fsencode(self._folder), os.fsencode(self._home))
        parcel = pack(self._folder, stamps)
        if status is not None:
            shutil.rmtree(self._place, ignore_errors=True)
        return status, parcel, log

    def stop(self) -> None:
        self._process.send_signal(signal.SIGTERM)


def _is_abandoned(folder: Path) -> bool:
    """Whether a killed sweep has left it."""
    try:
        begins = time.time() - folder.stat().st_mtime < BEGIN_SECONDS  # another one's may not be locked yet
        lock = None if begins else take_lock(folder / "lock", patience=0.0)
    except FileNotFoundError:  # another run has just removed it
        return False
    if lock is not None:
        os.close(lock)
    return lock is not None
