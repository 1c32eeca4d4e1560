"""A full disk for the ring, for checkpoints, for the log of Redis: ``python -m tests.faults.disk_full [--tries 3]``.

It is a small tmpfs; to mount one needs root.
"""

import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import CheckpointError
from tests.faults.kill_redis import LoggedRedis, logged_redis
from tests.faults.loaded import ROOMY, Loaded
from tests.faults.row import Row, at_length
from tests.integration.running import Training

FULL_SECONDS = 5.0


@contextmanager
def small_disk(place: Path, megabytes: int) -> Iterator[Path]:
    """A file system of its own."""
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(place)], check=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


@contextmanager
def filled(disk: Path) -> Iterator[None]:
    """No room there for so long."""
    ballast = disk / "ballast"
    with ballast.open("wb", buffering=0) as file:
        with suppress(OSError):
            os.posix_fallocate(file.fileno(), 0, shutil.disk_usage(disk).free)  # nearly all of it, at once
        file.seek(0, os.SEEK_END)
        with suppress(OSError):
            while True:
                file.write(bytes(1 << 16))
    try:
        yield
    finally:
        ballast.unlink()


def fill_disks(tries: int, folder: Path) -> Iterator[Row]:
    """The three of them."""
    yield _ring(folder)
    yield _checkpoint(tries, folder)
    yield _log_of_redis(tries, folder)


def _ring(folder: Path) -> Row:
    """It does not fit: one line, before anything begins."""
    with (
        small_disk(folder / "small", 20) as disk,
        Training(disk / "run", "--capacity", "1000000", "--total-steps", "1000") as run,
    ):
        status, message = run.finish(60), run.text().strip()
    passed = status == 2 and len(message.splitlines()) == 1 and message.startswith("rmc: --capacity=1000000: ")
    return Row("disk full: no room for the ring", 1, passed, found={"said": message.replace(str(folder), "")})


def _checkpoint(tries: int, folder: Path) -> Row:
    """It is told and tried again, training goes on, and no half of one is left."""
    with small_disk(folder / "middle", 400) as disk:
        (disk / "run").mkdir()
        (folder / "run").symlink_to(disk / "run")  # what it prints goes elsewhere
        with Loaded(folder / "run", *ROOMY, "--checkpoint-steps", "500") as run:
            run.begin()
            checkpoints, slowest, halves = CheckpointFolder(run.folder / "checkpoints"), 0.0, 0
            for _ in range(tries):
                run.until(checkpoints.numbers)
                with filled(disk):
                    before = checkpoints.numbers()
                    goes_on_unsaved(run)
                    time.sleep(FULL_SECONDS)
                    halves += checkpoints.numbers()[-1] != before[-1]
                slowest = max(slowest, run.until(lambda last=before[-1]: checkpoints.numbers()[-1] > last))
            torn = sum(not line.endswith("}") for line in (run.folder / "metrics.jsonl").read_text().splitlines())
            verdict = run.end()
        broken = sum(not is_whole(checkpoints, number) for number in checkpoints.numbers())
    passed = not (torn or broken or halves) and run.process.returncode == 130
    facts = {"torn_lines": torn, "broken_checkpoints": broken, "saved_without_room": halves}
    return Row.judged("disk full: no room for a checkpoint", tries, passed, verdict, slowest, facts)


def goes_on_unsaved(run: Loaded) -> None:
    """It says why, and goes on."""
    os.truncate(run.output, 0)
    run.until(lambda: "not saved: No space left on device" in run.text())
    run.until_all_go_on()


def is_whole(checkpoints: CheckpointFolder, number: int) -> bool:
    try:
        checkpoints.load(number)
    except CheckpointError:
        return False
    return True


def _log_of_redis(tries: int, folder: Path) -> Row:
    """Redis refuses writes: everyone waits, nothing is lost."""
    slowest = 0.0
    with (
        small_disk(folder / "log", 200) as disk,
        logged_redis(disk / "redis", folder / "redis.said") as server,
        Loaded(folder / "logged", redis_url=server.url) as run,
    ):
        run.begin()
        for _ in range(tries):
            with filled(disk):
                cannot_log(run, server)
                time.sleep(FULL_SECONDS)
            slowest = max(slowest, run.until_all_go_on())
        verdict = run.end()
    passed = run.process.returncode == 130
    return Row.judged("disk full: no room for the log of Redis", tries, passed, verdict, slowest)


def cannot_log(run: Loaded, server: LoggedRedis) -> None:
    """Wait until it says so."""
    server.forget()
    run.until(lambda: "Short write while writing to the AOF file" in server.log_text())


if __name__ == "__main__":
    at_length(__doc__, fill_disks, tries=3)
