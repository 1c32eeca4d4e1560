"""A real run under load, its acknowledgements written down as they come: two actors, Redis, replay server, learner."""

import re
import threading
import time
from collections.abc import Callable
from pathlib import Path

import psutil

from common.errors import BusUnavailable
from common.redis_bus import RedisBus
from deploy.presets import from_json
from deploy.redis_users import LAUNCHER, RedisUsers
from deploy.run_folder import RunFolder
from tests.faults.judge import Judgement, judge, newest
from tests.integration.running import Training

ACTORS = 2
ENDLESS = ("--total-steps", "100000000", "--replay-ratio", "4", "--actors", str(ACTORS), "--checkpoint-steps", "20000")
ROOMY = ("--capacity", "100000")  # windows: none is evicted before all are judged


class Loaded(Training):
    """Ready, with a learner that updates, once ``begin`` returns."""

    def __init__(self, folder: Path, *options: str) -> None:
        super().__init__(folder, *ENDLESS, *(options or ROOMY))
        self.acks: dict[tuple[int, int], int] = {}
        self._over = threading.Event()
        self._watch = threading.Thread(target=self._note_acks, daemon=True)

    def begin(self) -> None:
        """Wait for the first updates."""
        self.wait_for_updates()
        run = RunFolder(self.folder)
        self._users = RedisUsers(run.name, run.secret(), from_json((run.path / "config.json").read_bytes()).roles())
        self.bus = self.make_bus()
        self._watch.start()

    def make_bus(self, user: str = LAUNCHER) -> RedisBus:
        """The run's bus, for one thread."""
        (socket,) = (path for path in self.sockets() if path.name == "redis.sock")
        return RedisBus(f"unix://{self._users.login(user)}{socket}", self._users.run)

    def _note_acks(self) -> None:
        bus = self.make_bus()
        while not self._over.is_set():
            try:
                for actor in range(ACTORS):
                    ack = bus.ack(actor)
                    if ack is not None:
                        newest(self.acks, actor, ack.id)
            except BusUnavailable:
                pass
            time.sleep(0.005)

    def process_of(self, role: str) -> psutil.Process:
        """The process of ``actor-1``, ``learner``, ``replay`` or ``redis``."""
        word, _, index = role.partition("-")
        pattern = "unixsocket" if role == "redis" else rf"deploy\.cli {word} .*{f'--index {index}' if index else ''}"
        found: list[psutil.Process] = []

        def there() -> bool:
            found[:] = [one for one in self.launcher.children(recursive=True) if _matches(one, pattern)]
            return bool(found)

        self.wait_for(there)
        return found[0]

    def until(self, condition: Callable[[], object], seconds: float = 60.0) -> float:
        """Wait for it, however Redis is; how long that took."""
        began = time.monotonic()
        while True:
            try:
                if condition():
                    return time.monotonic() - began
            except BusUnavailable:
                pass
            assert self.process.poll() is None, self.text()
            assert time.monotonic() < began + seconds, f"waited {seconds} s in vain:\n{self.logs()}"
            time.sleep(0.01)

    def end(self) -> Judgement:
        """Stop it in order, and judge what its ring holds."""
        self._over.set()
        self._watch.join()
        self.interrupt()
        return judge(self.folder, self.acks)


def _matches(process: psutil.Process, pattern: str) -> bool:
    try:
        return re.search(pattern, " ".join(process.cmdline())) is not None
    except psutil.NoSuchProcess:
        return False
