"""A folder of checkpoints that are whole or absent: temp folder, fsync, rename, SHA-256 manifest.

``checkpoints/000001200/{FILES…, manifest.json}``, one folder an update count; ``checkpoints/best.json`` names
the best one evaluated, which is kept beside the newest few, ``checkpoints/epoch`` the writer's epoch, and
``checkpoints/save-seconds`` how long its last save took.
"""

import hashlib
import json
import logging
import os
import shutil
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from rmc.common.errors import CheckpointError, ConfigError
from rmc.common.process.file_lock import release_lock, take_lock
from rmc.common.whole_file import write_synced, write_whole

STATE, POLICY, PROGRESS = "learner.pt", "policy.safetensors", "progress.json"
log = logging.getLogger(__name__)
MANIFEST = "manifest.json"
BEST = "best.json"
EPOCH, SAVE_SECONDS = "epoch", "save-seconds"
SAVES_GRANTED = 3  # a writer that is told to end may take so many times its last save


class CheckpointFolder:
    """Numbered checkpoints under one folder. ``locked`` writers exclude each other; readers need no lock."""

    def __init__(self, folder: Path, keep: int = 3) -> None:
        self.folder, self.keep = folder, keep
        self._lock: int | None = None
        self.damaged: dict[int, str] = {}  # their faults; passed over by latest(): the run goes on from before them

    def lock(self) -> None:
        """Become the one writer. Raises ConfigError where another process stays it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = take_lock(self.folder / ".lock")
        if self._lock is None:
            fix = "another process trains in this folder; stop it first"
            raise ConfigError("--run-dir", str(self.folder.parent), fix)
        for old in self.folder.glob(".tmp-*.old"):  # of a save that was killed between its two renames
            with suppress(OSError):  # the new one is there
                old.rename(self.path(int(old.stem.removeprefix(".tmp-"))))
        for leftover in self.folder.glob(".tmp-*"):
            shutil.rmtree(leftover)

    def unlock(self) -> None:
        """Let another writer in."""
        if self._lock is not None:
            release_lock(self._lock)
            self._lock = None

    def numbers(self) -> list[int]:
        """Update counts of the checkpoints here, ascending; not yet verified."""
        return sorted(int(path.name) for path in self.folder.glob("[0-9]*") if path.name.isdecimal())

    def path(self, number: int) -> Path:
        """Where a checkpoint lies."""
        return self.folder / f"{number:09d}"

    def save(self, number: int, files: Mapping[str, bytes]) -> None:
        """Write a checkpoint so that it is there whole or not at all, then drop the oldest ones.

        Raises CheckpointError where it cannot be written; those before it stay, and nothing of it.
        """
        temporary, final = self.folder / f".tmp-{number:09d}", self.path(number)
        replaced = temporary.with_suffix(".old")
        _check_names(final, files)
        for left in (temporary, replaced):
            shutil.rmtree(left, ignore_errors=True)
        try:
            with suppress(FileExistsError):
                self.folder.mkdir()  # not its parents: a run's folder that was moved is not begun anew
            temporary.mkdir()
            for name, content in {**files, MANIFEST: _manifest(number, files)}.items():
                write_synced(temporary / name, content)
            _sync_folder(temporary)
            if final.exists():  # a resumed run repeats this number: the new one replaces the old
                final.rename(replaced)
            temporary.rename(final)
            _sync_folder(self.folder)
            shutil.rmtree(replaced, ignore_errors=True)
        except OSError as error:
            with suppress(OSError):  # it was not replaced
                replaced.rename(final)
            shutil.rmtree(temporary, ignore_errors=True)
            reason = error.strerror or "?"
            raise CheckpointError(f"checkpoint {final} cannot be written ({reason})", reason) from None
        self.damaged.pop(number, None)
        self._prune(number)

    def note_epoch(self, epoch: int) -> None:
        """The writer's, so that the next one's is larger though Redis forgets; where there is no room, unnoted."""
        self._note(EPOCH, str(epoch))

    def last_epoch(self) -> int:
        """What was noted last; 0 where nothing was."""
        try:
            return int((self.folder / EPOCH).read_bytes())
        except (OSError, ValueError):
            return 0

    def note_save(self, seconds: float) -> None:
        """How long it takes to end: an update, and a save from the first look at the state until it is on the disk."""
        self._note(SAVE_SECONDS, str(seconds))

    def last_save(self) -> float:
        """What was noted last; 0.0 where nothing was."""
        try:
            seconds = float((self.folder / SAVE_SECONDS).read_bytes())
        except (OSError, ValueError):
            return 0.0
        return seconds if 0.0 <= seconds < float("inf") else 0.0

    def patience(self, least: float) -> float:
        """The seconds in which a writer that is told to end can save, at least so many."""
        return max(least, SAVES_GRANTED * self.last_save())

    def _note(self, name: str, text: str) -> None:
        with suppress(OSError):
            write_whole(self.folder / name, text.encode())

    def _prune(self, written: int) -> None:
        """Drop the damaged, and the whole that are older than the newest few; what a fall back left newer not counted.

        A damaged one that can be read again later must not be resumed from: the run has gone another way.
        """
        best, numbers = self.best(), self.numbers()
        whole = [number for number in numbers if number <= written and number not in self.damaged]
        kept = {best, *whole[-self.keep :], *(number for number in numbers if number > written)} - self.damaged.keys()
        for number in numbers:
            if number not in kept:
                shutil.rmtree(self.path(number), ignore_errors=True)  # the next one tries again

    def load(self, number: int) -> dict[str, bytes]:
        """A checkpoint's files, verified. Raises CheckpointError naming the file at fault."""
        path = self.path(number)
        try:
            manifest = (path / MANIFEST).read_bytes()
            digests = dict(json.loads(manifest)["sha256"])
            _check_names(path, digests)
            files = {name: (path / name).read_bytes() for name in digests}
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise CheckpointError(f"checkpoint {path}: unreadable ({error})") from None
        if manifest == _manifest(number, files):
            return files
        for name, content in files.items():
            if hashlib.sha256(content).hexdigest() != digests[name]:
                raise CheckpointError(f"checkpoint {path}: {name} does not match its manifest")
        raise CheckpointError(f"checkpoint {path}: {MANIFEST} is not as it was written")

    def latest(self) -> tuple[int, dict[str, bytes]] | None:
        """The newest valid checkpoint; damaged ones are named in the log and passed over."""
        for number in reversed(self.numbers()):
            try:
                return number, self.load(number)
            except CheckpointError as error:
                log.warning("%s; it is passed over", error)
                self.damaged[number] = str(error)
        return None

    def mark_best(self, number: int, score: float) -> bool:
        """Record a checkpoint's evaluation if that beats the best so far; whether the checkpoint is there."""
        if not self.path(number).exists():
            return False
        before = self._best_record()
        if before is None or score > before["eval_return_mean"]:
            record = {"update": number, "eval_return_mean": score, "before": before}
            write_whole(self.folder / BEST, json.dumps(record).encode())
        return True

    def best(self) -> int | None:
        """Number of the best checkpoint evaluated so far, if any."""
        record = self._best_record()
        return None if record is None else record["update"]

    def _best_record(self) -> dict[str, Any] | None:
        """The best that is there, or the best before it: the learner may drop one just as the launcher marks it."""
        try:
            newest = json.loads((self.folder / BEST).read_bytes())
            for record in (newest, newest.get("before") or {}):
                number, score = int(record["update"]), float(record["eval_return_mean"])
                if self.path(number).exists():
                    return {"update": number, "eval_return_mean": score}
        except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            pass
        return None


def _check_names(path: Path, names: Iterable[str]) -> None:
    """Raises CheckpointError where one of a checkpoint's files would lie outside of its folder, or cannot lie there."""
    for name in names:
        plain = Path(name).name == name and name not in ("", "..", MANIFEST)
        if not (plain and name.isprintable()):  # no NUL, and no half of a surrogate pair, which no file can be called
            fix = "names must be plain, without a folder"
            raise CheckpointError(f"checkpoint {path}: file name {name!r} refused; {fix}", "file name")


def _manifest(number: int, files: Mapping[str, bytes]) -> bytes:
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    return json.dumps({"update": number, "sha256": digests}, indent=1).encode()


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
