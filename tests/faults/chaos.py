"""A run that suffers all faults at once, as a schedule has them, and who starts again what nobody else does."""

import heapq
import json
import os
import random
import re
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import count
from pathlib import Path

import psutil

from rmc.common.bus.redis_bus import RedisBus
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import STOPPED_STATUS
from rmc.deploy.run.folder import RunFolder
from tests.faults.broken_checkpoints import spoil
from tests.faults.disk_full import filled, is_whole
from tests.faults.kill_redis import LoggedRedis
from tests.faults.ledger import Ledger
from tests.faults.loaded import Loaded, anonymous_mb
from tests.faults.proxy import CALM, Interposed, Weather, tcp_proxy
from tests.faults.schedule import ACTORS, LAUNCHER, LEARNER, REDIS, ROLES, Fault
from tests.faults.soak import Looks
from tests.faults.witness import Witness, went_back
from tests.integration.running import DATA, FAST, SMALL

ENV, RATIO = "tests.memory_env:Memory12-v0", 8.0
SIZES = ("--actors", str(ACTORS), "--capacity", "500", "--checkpoint-steps", "1000", "--threads", "1")
OPTIONS = (*SMALL, *FAST, *DATA, "--alpha-learning-rate", "5e-3", *SIZES, "--replay-ratio", str(RATIO))
TICK_SECONDS, LOOK_SECONDS, SETTLED_SECONDS = 0.02, 5.0, 20.0  # SETTLED: a life's memory and files count from then on
PATIENCE, AGAIN_SECONDS = 600.0, 1.0  # for what must come; until who did not come up is started again
REDIS_TRIES, STAYED_SECONDS = 5, 10.0  # to start it, and for how long it must stay
WHOLE_BESIDE = 2  # whole checkpoints beside one that is damaged
DAMAGED_ROWS, CUT_BYTES = 3, 200
REFUSED = r"rmc: (--redis-url=|--capacity=.* make room|.*No space left)"  # a start amid a fault: nothing has happened
WEATHERS = {
    "late": Weather(late=0.1),
    "hangs": Weather(late=5.0),  # longer than a call waits for Redis
    "bytes": Weather(piece=1),
    "cut": Weather(cut=5_000),
}


class Chaos:
    """``begin``, ``suffer`` faults, ``end``; then ``close``."""

    def __init__(self, place: Path, redis: LoggedRedis, disks: dict[str, Path], log: Path) -> None:
        """The run's folder is ``run`` in ``place``; ``disks``, ``run`` and ``log``, may be filled."""
        self.folder = place / "run"
        self.witness, self.weights_went_back = Witness(ACTORS), 0
        self.happened: Counter[tuple[str, str]] = Counter()  # by kind and target
        self.refused_starts = 0
        self.unexpected: list[str] = []  # what a launcher said that ended though nobody had killed it
        self.looks: dict[str, Looks] = {role: [] for role in (LAUNCHER, *ROLES)}
        self.launchers: list[int] = []
        self._run: Loaded | None = None
        self.redis_proxy, self.replay_proxy = tcp_proxy(redis.socket), Interposed(self._replay_socket)  # looks at once
        self._redis, self._disks, self._log = redis, disks, log.open("w")
        self._undo: list[tuple[float, int, Callable[[], None]]] = []
        self._number, self._full = count(), set[str]()
        self._redis_at = self._launch_at = self._look_at = 0.0  # no sooner than then
        self._command: tuple[str, ...] = ()
        self._killed, self._said_before, self._redis_tries = False, 0, 0

    # -- from the beginning to the end ------------------------------------------------------------------

    def begin(self) -> None:
        """Until the learner updates."""
        self._start()
        there = self._there()
        there.wait_for(lambda: there.newest("learner", "updates"), PATIENCE)
        run = RunFolder(self.folder)
        self.ledger = Ledger(run)
        self.witness.start(RedisBus(self._redis.url, run.name))

    def suffer(self, faults: Iterable[Fault], seconds: float) -> None:
        """Each in its time, or later where this machine has none left; all are over after so long."""
        began, rest = time.monotonic(), iter(faults)
        fault = next(rest, None)
        while (now := time.monotonic() - began) < seconds or fault is not None:
            while fault is not None and fault.at <= now:
                self.happen(fault, now)
                fault = next(rest, None)
            self._take_back(time.monotonic())
            self._tend()
            time.sleep(TICK_SECONDS)
        self._take_back(float("inf"))
        self._redis_at = self._launch_at = 0.0

    def until_all_go_on(self) -> float:
        """Acknowledgements of every actor, and weights; how many seconds that took."""
        began, acks, versions = time.monotonic(), self.witness.acks.copy(), len(self.witness.versions)

        def moved() -> bool:
            now = {life for life, seq in self.witness.acks.copy().items() if acks.get(life) != seq}
            return len({actor for actor, _ in now}) == ACTORS and len(self.witness.versions) > versions

        self._wait(moved)
        return time.monotonic() - began

    def stop(self) -> None:
        """Ctrl-C."""
        run = self._there()
        run.interrupt()
        self._killed = True
        if run.process.returncode != STOPPED_STATUS:
            self.unexpected.append(f"Ctrl-C: status {run.process.returncode}: {self._last_words()}")

    def end(self, more: float) -> int:
        """Of one that is stopped or killed, by ``rmc resume`` for a share of its steps more; the steps of all."""
        steps = int(self.ledger.env_steps * (1 + more))
        self._there().close()
        self._launch_at, self._command = 0.0, ("resume", str(self.folder), "--total-steps", str(steps))
        self._run = None
        self._tend()
        last = self._there()
        self._killed = True  # from here on it ends of itself
        self._wait(lambda: last.process.poll() is not None, 3600.0)
        if last.process.returncode != 0:
            self.unexpected.append(f"status {last.process.returncode}: {self._last_words()}")
        return steps

    def close(self) -> None:
        """Kill what is left, look no more."""
        self._take_back(float("inf"))
        self.witness.stop()
        if self._run is not None:
            self._run.close()
        self.redis_proxy.close()
        self.replay_proxy.close()
        self._log.close()

    def _wait(self, condition: Callable[[], bool], seconds: float = PATIENCE) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, f"waited {seconds} s in vain: {self.unexpected}\n{self._last_words()}"
            self._tend()
            time.sleep(TICK_SECONDS)

    # -- what is started again, and looked at ------------------------------------------------------------

    def _tend(self) -> None:
        now = time.monotonic()
        if now >= self._redis_at:
            self._tend_redis(now)
        if self._run is not None and self._run.process.poll() is not None:
            self._note_end(self._run)
        if self._run is None and now >= self._launch_at:
            self._start()
        self.ledger.look()
        if now >= self._look_at and self._run is not None:
            self._look_at = now + LOOK_SECONDS
            self._look(self._run)

    def _tend_redis(self, now: float) -> None:
        """Start it again; one that does not come up, as its log is torn amid a full disk, without that log."""
        if self._redis.process.poll() is None:
            self._redis_tries *= now < self._redis_at + STAYED_SECONDS
            return
        if self._redis_tries == REDIS_TRIES:
            self._say(redis=self._redis.log_text()[-1000:])
            self.happened["torn log", REDIS] += 1
            shutil.rmtree(self._redis.folder / "appendonlydir", ignore_errors=True)
            self._redis_tries = 0
        self._redis_tries += 1
        self.weights_went_back += went_back(self.witness.versions)
        self.witness.redis_came_back()
        self._redis.launch()
        self._redis_at = now + AGAIN_SECONDS

    def _start(self) -> None:
        """By ``rmc train`` as ever, if no other command was given."""
        output = self.folder.parent / "run.out"
        self._said_before = output.stat().st_size if output.exists() else 0
        host, port = self.redis_proxy.address
        url = f"redis://{host}:{port}"
        self._run = Loaded(self.folder, *OPTIONS, redis_url=url, env=ENV, command=self._command)
        self._killed, self._command = False, ()
        self.launchers.append(self._run.process.pid)

    def _note_end(self, run: Loaded) -> None:
        """Of a launcher: killed, refused amid a fault, or for another cause, which must not be."""
        if not self._killed:
            words = self._last_words()
            if re.search(REFUSED, words) and "Traceback" not in words:
                self.refused_starts += 1
            else:
                self.unexpected.append(f"status {run.process.returncode}: {words}")
            self._launch_at = max(self._launch_at, time.monotonic() + AGAIN_SECONDS)
            self._say(ended=run.process.returncode, words=words)
        run.close()
        self._run = None

    def _last_words(self) -> str:
        """What the newest launcher said, its end."""
        return (self.folder.parent / "run.out").read_bytes()[self._said_before :].decode(errors="replace")[-2000:]

    def _look(self, run: Loaded) -> None:
        for role, looks in self.looks.items():
            with suppress(psutil.Error, OSError):
                process = run.find(role)
                if process is None or time.time() - process.create_time() < SETTLED_SECONDS:
                    continue
                looks.append({role: (anonymous_mb(process.pid), process.num_fds())})

    def _there(self) -> Loaded:
        assert self._run is not None
        return self._run

    def _replay_socket(self) -> Path | None:
        run = self._run
        return next((path for path in run.sockets() if path.name == "replay.sock"), None) if run is not None else None

    # -- faults ------------------------------------------------------------------------------------------

    def happen(self, fault: Fault, now: float = 0.0) -> None:
        """Let it begin, ``now`` seconds after the first. The log says so, or why it did not."""
        faults = {
            "kill": self._kill,
            "kill redis": self._kill_redis,
            "kill launcher": self._kill_launcher,
            "kill node": self._kill_node,
            "freeze": self._freeze,
            "redis proxy": self._change_redis_weather,
            "replay proxy": self._change_replay_weather,
            "disk full": self._fill,
            "damage": self._damage,
        }
        try:
            why_not = faults[fault.kind](fault)
        except psutil.NoSuchProcess:
            why_not = "it has just ended"
        if not why_not:
            self.happened[fault.kind, fault.target] += 1
        self._say(**vars(fault), began=round(now, 3), why_not=why_not)

    def _say(self, **facts: object) -> None:
        self._log.write(json.dumps(facts) + "\n")
        self._log.flush()

    def _later(self, seconds: float, action: Callable[[], None]) -> None:
        heapq.heappush(self._undo, (time.monotonic() + seconds, next(self._number), action))

    def _take_back(self, until: float) -> None:
        while self._undo and self._undo[0][0] <= until:
            heapq.heappop(self._undo)[2]()

    def _process(self, target: str) -> psutil.Process | None:
        if target == REDIS:
            return psutil.Process(self._redis.process.pid) if self._redis.process.poll() is None else None
        return self._run.find(target) if self._run is not None else None

    def _kill(self, fault: Fault) -> str:
        process = self._process(fault.target)
        if process is None:
            return "nobody there"
        if fault.target == LEARNER:
            self._share_memory(fault.chance < 0.5)
        process.kill()
        return ""

    def _share_memory(self, shared: bool) -> None:
        """Whether the next learners draw through memory that they share, or the socket alone, as with a GPU."""
        mark = self._there().armed / "no-shared-memory"
        if shared:
            mark.unlink(missing_ok=True)
        else:
            mark.touch()

    def _kill_redis(self, fault: Fault) -> str:
        if self._redis.process.poll() is not None:
            return "nobody there"
        self._redis.kill()
        self._redis_at = time.monotonic() + fault.seconds
        if fault.target == "comes back empty":
            shutil.rmtree(self._redis.folder / "appendonlydir", ignore_errors=True)
        return ""

    def _kill_launcher(self, fault: Fault) -> str:
        """Its roles end with it; ``rmc train`` as ever goes on."""
        if self._run is None:
            return "nobody there"
        self._killed, self._launch_at = True, time.monotonic() + fault.seconds
        self._run.launcher.kill()
        return ""

    def _kill_node(self, fault: Fault) -> str:
        """Launcher, roles and Redis at once; ``rmc resume`` goes on."""
        if self._run is None:
            return "nobody there"
        self._killed, self._launch_at = True, time.monotonic() + fault.seconds
        self._command = ("resume", str(self.folder))
        self._share_memory(fault.chance < 0.5)
        if self._redis.process.poll() is None:
            self._redis.kill()
        self._run.kill_all()
        return ""

    def _freeze(self, fault: Fault) -> str:
        process = self._process(fault.target)
        if process is None or process.status() == psutil.STATUS_STOPPED:
            return "nobody there" if process is None else "it stands still already"
        process.suspend()

        def go_on() -> None:
            with suppress(psutil.NoSuchProcess):
                process.resume()

        self._later(fault.seconds, go_on)
        return ""

    def _change_redis_weather(self, fault: Fault) -> str:
        self.redis_proxy.weather = WEATHERS[fault.target]
        self._later(fault.seconds, lambda: setattr(self.redis_proxy, "weather", CALM))
        return ""

    def _change_replay_weather(self, fault: Fault) -> str:
        self.replay_proxy.change(WEATHERS[fault.target])
        self._later(fault.seconds, lambda: self.replay_proxy.change(CALM))
        return ""

    def _fill(self, fault: Fault) -> str:
        if fault.target in self._full or fault.target not in self._disks:
            return "it is full already" if fault.target in self._full else "only root can mount a small disk"
        fullness = filled(self._disks[fault.target])
        fullness.__enter__()
        self._full.add(fault.target)

        def make_room() -> None:
            fullness.__exit__(None, None, None)
            self._full.discard(fault.target)

        self._later(fault.seconds, make_room)
        return ""

    def _damage(self, fault: Fault) -> str:
        if fault.target == "rows":
            found = [self.ledger.damage((fault.chance + number / DAMAGED_ROWS) % 1.0) for number in range(DAMAGED_ROWS)]
            return "" if any(found) else "no window is old enough"
        if fault.target == "checkpoint":
            return self._damage_checkpoint(random.Random(fault.chance))
        metrics = self.folder / "metrics.jsonl"
        os.truncate(metrics, max(0, metrics.stat().st_size - 1 - int(fault.chance * CUT_BYTES)))
        return ""

    def _damage_checkpoint(self, chance: random.Random) -> str:
        """The newest one's, and the learner is killed: the next one has to do without it."""
        place = CheckpointFolder(self.folder / "checkpoints")
        *older, newest = [number for number in place.numbers() if is_whole(place, number)] or [0]
        learner = self._process(LEARNER)
        if len(older) < WHOLE_BESIDE or learner is None:
            return "too few whole ones beside it, or no learner"
        try:
            spoil(chance.choice(sorted(place.path(newest).iterdir())), chance.choice(["flipped", "cut"]), chance)
        except (OSError, IndexError):
            return "it has just been replaced, or there is no room"
        learner.kill()
        return ""
