"""kill -9 of Redis under load, with its log and empty: ``python -m tests.faults.kill_redis [--tries 20]``."""

import os
import random
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import redis

from rmc.deploy.redis.server import server_binary
from tests.faults.loaded import Loaded
from tests.faults.row import Row, at_length
from tests.faults.witness import went_back
from tests.waiting import wait_until

RECOVERY_S = 5.0


class LoggedRedis:
    """A user's own, on a unix socket, with an append-only file that is written every second."""

    def __init__(self, folder: Path, log: Path) -> None:
        """Its append-only file lies in ``folder``; ``log`` is where it tells what it does."""
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.socket = folder, folder / "own.sock"
        self.url = f"unix://{self.socket}"
        self._words = [
            server_binary(), "--port", "0", "--unixsocket", str(self.socket), "--dir", str(folder), "--save", "",
            "--appendonly", "yes", "--appendfsync", "everysec",
        ]  # fmt: skip
        self._log = log
        self.start()

    def launch(self) -> None:
        """Begin with what the log holds."""
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(self._words, stdout=log, stderr=log)

    def start(self) -> None:
        """The same; returns once it answers."""
        self.launch()
        with redis.Redis.from_url(self.url) as client:
            wait_until(lambda: _answers(client), 20.0, self.log_text, 0.01)

    def log_text(self) -> str:
        """What it told."""
        return self._log.read_text()

    def forget(self) -> None:
        """That, so far."""
        os.truncate(self._log, 0)

    def kill(self) -> None:
        """kill -9."""
        self.process.kill()
        self.process.wait()


def _answers(client: redis.Redis) -> bool:
    try:
        return bool(client.ping())
    except redis.exceptions.ConnectionError:
        return False


@contextmanager
def logged_redis(folder: Path, log: Path) -> Iterator[LoggedRedis]:
    """Killed at the end."""
    server = LoggedRedis(folder, log)
    try:
        yield server
    finally:
        server.kill()


def kill_logged(tries: int, folder: Path) -> Iterator[Row]:
    """It comes back with all but the last second or so."""
    chance, slowest = random.Random(0), 0.0
    with (
        logged_redis(folder / "redis", folder / "redis.said") as server,
        Loaded(folder / "logged", redis_url=server.url) as run,
    ):
        run.begin()
        for _ in range(tries):
            time.sleep(chance.uniform(0.2, 1.5))
            server.kill()
            time.sleep(chance.uniform(0.0, 2.0))
            server.start()
            slowest = max(slowest, run.until_all_go_on())
        yield _row("kill -9 of Redis, with its append-only file", run, tries, slowest)


def kill_embedded(tries: int, folder: Path) -> Iterator[Row]:
    """It comes back with nothing."""
    chance, slowest = random.Random(0), 0.0
    with Loaded(folder / "empty") as run:
        run.begin()
        for _ in range(tries):
            time.sleep(chance.uniform(0.2, 1.5))
            run.process_of("redis").kill()
            slowest = max(slowest, run.until_all_go_on())
        yield _row("kill -9 of Redis, which comes back empty", run, tries, slowest)


def _row(fault: str, run: Loaded, tries: int, slowest: float) -> Row:
    verdict = run.end()
    passed = not verdict.acted_on_older and slowest < RECOVERY_S
    facts = {
        "acted_on_older_weights": verdict.acted_on_older,
        "its_log_lacked_weights": went_back(run.witness.versions),
    }
    return Row.judged(fault, tries, passed, verdict, slowest, facts)


def both(tries: int, folder: Path) -> Iterator[Row]:
    """With its log, then empty."""
    yield from kill_logged(tries, folder)
    yield from kill_embedded(tries, folder)


if __name__ == "__main__":
    at_length(__doc__, both, tries=20)
