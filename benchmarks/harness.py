"""What every benchmark needs: rounds in which ours, its peers and the ceiling take turns, and a file of what came."""

import argparse
import json
import multiprocessing
import os
import shlex
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import psutil

from benchmarks import PEER_ENVIRONMENT, report
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.shard import WHOLE, Shard
from rmc.common.window import Rows, WindowSpec
from rmc.deploy.redis.server import RedisServer
from rmc.replay_server.config import ReplayConfig
from rmc.replay_server.process import ReplayProcess
from rmc.replay_server.server import ReplayServer
from rmc.replay_server.socket_server import SocketServer

HERE = Path(__file__).parent
SECRET = b"benchmark"
RUN = "benchmark"
ENDLESS = 10**12
START_SECONDS = 120.0  # TensorFlow takes its time
Measure = Callable[[], float]


@dataclass(frozen=True)
class Row:
    """One measurement: medians over the rounds."""

    name: str
    unit: str
    ours: float
    peer: str  # what ours is compared with; "" where there is none
    peer_value: float | None  # None: it is not installed
    ratio: float | None  # how many times better ours is: median of the rounds' own ratios
    limit: float | None  # the ceiling
    limit_is: str
    spread: dict[str, tuple[float, float | None]]  # least and largest of ours, peer and limit; None: never
    rounds: int
    command: str


def compare(
    name: str,
    unit: str,
    ours: Measure,
    peers: dict[str, Measure | None],
    limit: tuple[str, Measure] | None = None,
    rounds: int = 5,
    less_is_better: bool = False,
) -> list[Row]:
    """Ours, each peer and the ceiling in turn, so many rounds; a row a peer. A peer that is None is not installed."""
    limit_is, measure_limit = limit or ("", None)
    values = _turns({"ours": ours, **peers, "limit": measure_limit}, rounds)
    rows = []
    for peer in peers or {"": None}:
        times = {"ours": values["ours"], "peer": values.get(peer, []), "limit": values["limit"]}
        own, its, most = (statistics.median(samples) if samples else None for samples in times.values())
        assert own is not None
        ratios = [b / a if less_is_better else a / b for a, b in zip(times["ours"], times["peer"], strict=False)]
        ratio = statistics.median(ratios) if ratios else None
        spread = {key: (min(samples), max(samples)) for key, samples in times.items() if samples}
        rows.append(Row(name, unit, own, peer, its, ratio, most, limit_is, spread, rounds, command()))
    return rows


def _turns(columns: dict[str, Measure | None], rounds: int) -> dict[str, list[float]]:
    """What each measured, once a round; nothing of one that is None."""
    values: dict[str, list[float]] = {key: [] for key in columns}
    for _ in range(rounds):
        for key, measure in columns.items():
            if measure is not None:
                values[key].append(measure())
    return values


def command() -> str:
    """What was typed to measure this."""
    return shlex.join(["python", "-m", f"benchmarks.{Path(sys.argv[0]).stem}", *sys.argv[1:]])


def save(rows: list[Row]) -> None:
    """Into today's file of results, in place of what was measured before under the same name; and print them."""
    path = HERE / "results" / f"{time.strftime('%Y-%m-%d')}.json"
    before = json.loads(path.read_text()) if path.exists() else []
    new = {(row.name, row.peer) for row in rows}
    kept = [row for row in before if (row["name"], row["peer"]) not in new]
    path.write_text(json.dumps([*kept, *(asdict(row) for row in rows)], indent=1) + "\n")
    for row in rows:
        print(report.line([asdict(row) | {"day": "now"}]), flush=True)


def argument_parser(doc: str | None) -> argparse.ArgumentParser:
    """With what every benchmark takes."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5, help="in each of which ours and all peers take a turn")
    parser.add_argument("--seconds", type=float, default=4.0, help="of one turn")
    return parser


class Peer:
    """Another project's code in an environment of its own: a process that measures once for each line it is sent.

    ``benchmarks/peers/SCRIPT.py`` prints ``{"ready": true}`` once it can, and ``{"value": speed}`` for each line, the
    seconds to measure for. Both may stand amid other output, on lines of their own.
    """

    def __init__(self, python: Path, script: str, *words: str) -> None:
        command = [str(python), str(HERE / "peers" / f"{script}.py"), *words]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, text=True, start_new_session=True, env=PEER_ENVIRONMENT
        )
        self._answer()

    def measure(self, seconds: float) -> float:
        """One turn."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{seconds}\n")
        self._process.stdin.flush()
        return float(self._answer()["value"])

    def _answer(self) -> dict[str, float]:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                return dict(json.loads(line))
        raise RuntimeError(f"{self._process.args!r} ended with {self._process.wait()}")

    def __enter__(self) -> "Peer":
        return self

    def __exit__(self, *_: object) -> None:
        os.killpg(self._process.pid, signal.SIGKILL)  # with the servers that it has started
        self._process.wait()


def peer_python(environment: str) -> Path | None:
    """The Python of a peer's environment, as ``make peers`` made it, or None."""
    python = HERE.parent / f".venv-{environment}" / "bin" / "python"
    return python if python.exists() else None


def started_peer(stack: ExitStack, environment: str, script: str, seconds: float, *words: object) -> Measure | None:
    """A peer's turns of so many seconds, until the stack is closed; None where it is not installed."""
    python = peer_python(environment)
    if python is None:
        return None
    peer = stack.enter_context(Peer(python, script, *map(str, words)))
    return lambda: peer.measure(seconds)


@contextmanager
def on_cores(cores: set[int]) -> Iterator[None]:
    """This process, and those that it starts meanwhile, on these cores only."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextmanager
def running(processes: Iterable[psutil.Process]) -> Iterator[None]:
    """Processes that are stopped outside of their turns."""
    for process in processes:
        process.resume()
    yield
    for process in processes:
        process.suspend()


def random_rows(spec: WindowSpec, count: int) -> Rows:
    """Full windows of plausible numbers."""
    rng = np.random.default_rng(0)
    rows = np.zeros(count, spec.dtype)
    rows["last"], rows["episode_step"] = spec.steps, spec.burn_in
    rows["new_steps"] = rows["new_observations"] = spec.train
    for name in ("observation", "action", "prev_action", "reward", "state"):
        rows[name] = rng.uniform(-1.0, 1.0, rows[name].shape)
    return rows


def serve(url: str, folder: str, spec: WindowSpec, config: ReplayConfig, actors: int = 1, shard: Shard = WHOLE) -> None:
    """A replay server as a run has it, until the run is asked to stop."""
    bus = RedisBus(url, RUN)
    server = ReplayServer(spec, config, Path(folder), 0, ENDLESS, actors, ENDLESS, bus, shard)
    process = ReplayProcess(server, SocketServer(server, f"unix:{folder}/replay.sock", SECRET, 1024))
    while bus.stop_requested() is None:
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            process.step()
    process.close()


@contextmanager
def replay_process(spec: WindowSpec, config: ReplayConfig) -> Iterator[RedisBus]:
    """A real Redis and a real replay server on the last core; this process on the first."""
    cores = sorted(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as folder, RedisServer(Path(folder)) as redis:
        assert redis.process is not None
        os.sched_setaffinity(redis.process.pid, {cores[-1]})
        with on_cores({cores[0]}):
            bus = RedisBus(redis.url(), RUN)
            server = multiprocessing.get_context("spawn").Process(
                target=serve, args=(redis.url(), folder, spec, config)
            )
            server.start()
            os.sched_setaffinity(server.pid or 0, {cores[-1]})
            while bus.replay_address("replay") is None:
                time.sleep(0.05)
            try:
                yield bus
            finally:
                for process in psutil.Process().children(recursive=True):  # a stopped one cannot end
                    process.resume()
                bus.request_stop("done")
                server.join()
