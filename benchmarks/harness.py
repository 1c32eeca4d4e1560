"""What every benchmark needs: alternating pairs, medians with their range, and a real replay process."""

import json
import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from common.redis_bus import RedisBus
from common.window import Rows, WindowSpec
from deploy.redis_server import RedisServer
from replay_server.process import ReplayProcess
from replay_server.server import ReplayConfig, ReplayServer
from replay_server.socket_server import SocketServer

SECRET = b"benchmark"
RUN = "benchmark"
ENDLESS = 10**12


@dataclass(frozen=True)
class Row:
    """One measurement: medians over the pairs, (min, max) as the spread."""

    name: str
    unit: str
    ours: float
    ours_range: tuple[float, float]
    ceiling: float
    ceiling_range: tuple[float, float]
    ceiling_is: str
    ratio: float  # median of the pairs' own ratios
    pairs: int

    def show(self) -> str:
        """One line for people."""
        return (
            f"{self.name:32s} {self.ours:12,.1f} {self.unit:12s} {100 * self.ratio:5.1f} % of {self.ceiling:,.1f} "
            f"({self.ceiling_is}); range {self.ours_range[0]:,.1f} to {self.ours_range[1]:,.1f}, {self.pairs} pairs"
        )


def alternate(
    name: str, unit: str, ours: Callable[[], float], ceiling: Callable[[], float], ceiling_is: str, pairs: int
) -> Row:
    """Measure A B A B …; each callable runs for some seconds and returns its speed."""
    a, b = [], []
    for _ in range(pairs):
        a.append(ours())
        b.append(ceiling())
    ratio = statistics.median(x / y for x, y in zip(a, b, strict=True))
    medians = statistics.median(a), statistics.median(b)
    return Row(name, unit, medians[0], (min(a), max(a)), medians[1], (min(b), max(b)), ceiling_is, ratio, pairs)


def speed(work: Callable[[], int], seconds: float) -> float:
    """Units of work a second, ``work`` returning how many it did."""
    done, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        done += work()
    return done / (time.perf_counter() - start)


def random_rows(spec: WindowSpec, count: int) -> Rows:
    """Full windows of plausible numbers."""
    rng = np.random.default_rng(0)
    rows = np.zeros(count, spec.dtype)
    rows["last"] = spec.steps
    rows["new_steps"] = rows["new_observations"] = spec.train
    for name in ("observation", "action", "prev_action", "reward", "hidden"):
        rows[name] = rng.uniform(-1.0, 1.0, rows[name].shape)
    return rows


def _serve(url: str, folder: str, spec: WindowSpec, config: ReplayConfig, actors: int, core: int) -> None:
    os.sched_setaffinity(0, {core})
    bus = RedisBus(url, RUN)
    server = ReplayServer(spec, config, Path(folder), 0, ENDLESS, actors, ENDLESS, bus)
    process = ReplayProcess(server, SocketServer(server, spec, f"unix:{folder}/replay.sock", SECRET, 1024))
    while bus.stop_requested() is None:
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            process.step()
    process.close()


@contextmanager
def replay_process(spec: WindowSpec, config: ReplayConfig, actors: int = 1) -> Iterator[RedisBus]:
    """A real Redis and a real replay server on the last core; this process on the first."""
    cores = sorted(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as folder, RedisServer(Path(folder)) as redis:
        assert redis.process is not None
        os.sched_setaffinity(redis.process.pid, {cores[-1]})
        os.sched_setaffinity(0, {cores[0]})
        bus = RedisBus(redis.url, RUN)
        server = multiprocessing.get_context("spawn").Process(
            target=_serve, args=(redis.url, folder, spec, config, actors, cores[-1])
        )
        server.start()
        while bus.replay_address("replay") is None:
            time.sleep(0.05)
        yield bus
        bus.request_stop("done")
        server.join()
        os.sched_setaffinity(0, set(cores))


def record(rows: list[Row], path: Path, command: str) -> None:
    """Append the rows to a JSON-lines file, and print them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        for row in rows:
            file.write(json.dumps({**asdict(row), "time": time.strftime("%Y-%m-%d %H:%M"), "command": command}) + "\n")
            print(row.show())
