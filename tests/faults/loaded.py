"""A real run under load, its acknowledgements written down as they come: two actors, Redis, replay server, learner."""

import json
import os
import signal
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

import psutil

from rmc.common.bus.protocol import Version
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.errors import BusUnavailable
from rmc.deploy.redis.users import LAUNCHER, RedisUsers
from rmc.deploy.run.folder import RunFolder
from tests.faults.judge import Acks, Judgement, judge
from tests.faults.witness import Witness
from tests.integration.running import START_SECONDS, Training
from tests.processes import matching

ACTORS = 2
ENDLESS = ("--total-steps", "100000000", "--replay-ratio", "4", "--actors", str(ACTORS), "--checkpoint-steps", "20000")
ROOMY = ("--capacity", "100000")  # windows: none is evicted before all are judged
WRAPPING = ("--capacity", "2000")  # full within a minute
FILL_SECONDS = 200.0
HOOKS = Path(__file__).parent / "hooks"
NO_WEIGHTS = Version(0, 0)


class Loaded(Training):
    """Ready, with a learner that updates, once ``begin`` returns; ``arm`` lets a fault of ``hooks`` happen in it."""

    def __init__(
        self,
        folder: Path,
        *options: str,
        redis_url: str = "",
        env: str = "InvertedPendulum-v5",
        environment: Mapping[str, str] = MappingProxyType({}),
        command: tuple[str, ...] = (),
    ) -> None:
        """``command`` goes in the place of ``train`` and all of its options."""
        self.armed = folder.parent / f"{folder.name}-armed"
        self.armed.mkdir(exist_ok=True)
        path = os.pathsep.join([str(HOOKS), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
        hooks = {"PYTHONPATH": path, "RMC_FAULTS": str(self.armed)}
        place = ("--redis-url", redis_url) if redis_url else ()
        words = (*ENDLESS, *(options or ROOMY), *place)
        super().__init__(folder, *words, env=env, environment={**hooks, **environment}, command=command)
        self._redis_url = redis_url
        self.witness = Witness(ACTORS)

    def begin(self) -> None:
        """Wait for the first updates."""
        self.wait_for_updates()
        run = RunFolder(self.folder)
        self._users = RedisUsers(run.name, run.secret(), run.config().roles())
        self.bus = self.make_bus()
        self.witness.start(self.make_bus())

    def make_bus(self, user: str = LAUNCHER) -> RedisBus:
        """The run's bus, for one thread."""
        return RedisBus(self.url_of(user), self._users.run)

    def url_of(self, user: str) -> str:
        """Where a user of the run finds its Redis."""
        if self._redis_url:
            return self._redis_url
        (socket,) = (path for path in self.sockets() if path.name == "redis.sock")
        return f"unix://{self._users.login(user)}{socket}"

    @property
    def name(self) -> str:
        """The run's, in Redis."""
        return self._users.run

    def process_of(self, role: str) -> psutil.Process:
        """The process of a role, once it is there: see ``find``."""
        found: psutil.Process | None = None

        def there() -> bool:
            nonlocal found
            found = self.find(role)
            return found is not None

        self.wait_for(there)
        assert found is not None
        return found

    def find(self, role: str) -> psutil.Process | None:
        """The process of ``actor-1``, ``learner``, ``replay``, ``redis``, the ``fork server`` or the ``launcher``."""
        if role == "launcher":
            return self.launcher
        word, _, index = role.partition("-")
        others = {"redis": "unixsocket", "fork server": r"rmc\.cli\.fork_server"}
        pattern = others.get(role, rf"rmc\.cli\.main role {word} .*{f'--index {index}' if index else ''}")
        return next(matching(pattern, self.launcher.children(recursive=True)), None)

    def kill(self, role: str, number: signal.Signals = signal.SIGKILL) -> float:
        """kill -9, or another signal; how long it takes until it is back in a new epoch."""
        victim, epoch = self.process_of(role), self.bus.current_epoch(role)
        victim.send_signal(number)
        return self.until(lambda: self.bus.current_epoch(role) > epoch)

    def arm(self, fault: str) -> None:
        """Let it happen at the next occasion."""
        (self.armed / fault).touch()

    def slow_down(self, times: float) -> None:
        """Let every update of the learner take so many times as long, until it is said again."""
        new = self.armed / "slower.new"
        new.write_text(str(times))
        new.replace(self.armed / "slower")

    def events(self, name: str) -> list[dict[str, Any]]:
        """What the hooks have written down."""
        path = self.armed / f"said-{name}"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def strike(self, fault: str, role: str) -> float:
        """Arm a fault that kills the role; how long it takes from its death until it is back in a new epoch."""
        epoch, deaths = self.bus.current_epoch(role), len(self.events("died"))
        self.arm(fault)
        self.until(lambda: len(self.events("died")) > deaths)
        return self.until(lambda: self.bus.current_epoch(role) > epoch)

    def until(self, condition: Callable[[], object], seconds: float = START_SECONDS) -> float:
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

    def until_all_go_on(self) -> float:
        """Wait for acks of every actor, and weights, newer than all up to now; how long that took."""
        seen = self.witness
        acks, before = seen.acks.copy(), max(seen.versions, default=NO_WEIGHTS)
        return self.until(lambda: _all_moved(acks, seen.acks.copy()) and max(seen.versions, default=before) > before)

    def held(self) -> dict[str, tuple[float, int]]:
        """Of each process, and of an embedded Redis: memory that is no file's, so not the ring's, in MB; open files."""
        roles = ["launcher", "fork server", "replay", "learner", "evaluator"]
        roles += [f"actor-{actor}" for actor in range(ACTORS)] + ["redis"] * (not self._redis_url)
        processes = {role: self.process_of(role) for role in roles}
        return {role: (anonymous_mb(process.pid), process.num_fds()) for role, process in processes.items()}

    def kill_all(self) -> None:
        """Every process at once, the launcher first."""
        everyone = [self.launcher, *self.launcher.children(recursive=True)]
        self.witness.stop()
        for process in everyone:
            with suppress(psutil.NoSuchProcess):  # it has ended with the launcher
                process.send_signal(signal.SIGKILL)
        self.process.wait()
        psutil.wait_procs(everyone[1:], 10)

    def close(self) -> None:
        """Kill what is left, and look no more."""
        self.witness.stop()
        super().close()

    def end(self) -> Judgement:
        """Stop it cleanly, and judge what its ring holds."""
        self.witness.stop()
        self.interrupt()
        return judge(self.folder, self.witness.acks)


def anonymous_mb(pid: int) -> float:
    """Its memory that is no file's."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    (kilobytes,) = (line.split()[1] for line in lines if line.startswith("Anonymous:"))
    return int(kilobytes) / 1e3


def _all_moved(before: Acks, now: Acks) -> bool:
    return all(_of(now, actor) != _of(before, actor) for actor in range(ACTORS))


def _of(acks: Acks, actor: int) -> Acks:
    return {life: seq for life, seq in acks.items() if life[0] == actor}
