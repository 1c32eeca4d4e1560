"""Where Redis and the replay servers saturate: simulated actors that send recorded windows at a set rate.

    python -m benchmarks.scaling [--env ENV] [--actors 8] [--seconds 5] [--shards 1 2 4] [--alone replay]

Each simulated actor is a process with a bus of its own that sends one entry of 16 windows after another on a clock;
what is offered doubles until less than 95 % of it is committed. CPU time is read from the processes themselves, so that
it says what a core carries even where all share a few. ``--alone`` gives Redis or the replay servers the first core for
themselves, and all others the rest: what saturates then is known.
"""

import argparse
import json
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil

from benchmarks.harness import ENDLESS, RUN, random_rows, serve
from benchmarks.sender import CHUNK, Sender
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.env.config import EnvConfig
from rmc.common.shard import Shard
from rmc.common.window import WindowSpec
from rmc.common.wire import encode_windows
from rmc.deploy.redis.server import RedisServer
from rmc.deploy.run.presets import robust
from rmc.replay_server.config import ReplayConfig

BEHIND = 256  # entries that a simulated actor sends ahead of what is acknowledged: of 32 actors they fit into Redis
KEPT_UP = 0.95  # of what is offered


@dataclass(frozen=True)
class Point:
    """One load: windows a second offered and committed, and the share of a core that each process took."""

    shards: int
    actors: int
    alone: str  # what has the first core for itself
    offered: float
    committed: float
    redis_core: float
    replay_core: float  # of the busiest
    actor_core: float  # of all simulated actors
    idle: float  # cores of the machine
    stolen: float  # cores that the host kept to itself


def _simulate(url: str, actor: int, spec: WindowSpec, rate: float) -> None:
    """Send ``rate`` windows a second, as far as the acknowledged ones let it."""
    sender, payload = Sender(RedisBus(url, RUN), spec, actor), encode_windows(random_rows(spec, CHUNK), spec)
    period, due = CHUNK / rate, time.monotonic()
    while True:
        sender.wait(BEHIND - 1)
        due = max(due + period, time.monotonic() - 10 * period)
        time.sleep(max(0.0, due - time.monotonic()))
        sender.send(payload)


@contextmanager
def _system(spec: WindowSpec, shards: int, actors: int, rate: float) -> Iterator[tuple[RedisBus, dict[str, list[int]]]]:
    """Redis, replay servers and simulated actors as processes; their numbers by kind."""
    spawn = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder, RedisServer(Path(folder)) as redis:
        bus, config = RedisBus(redis.url(), RUN), ReplayConfig(capacity=4096 * shards, warmup_steps=ENDLESS)
        servers = [
            spawn.Process(target=serve, args=(redis.url(), f"{folder}/{k}", spec, config, actors, Shard(k, shards)))
            for k in range(shards)
        ]
        senders = [
            spawn.Process(target=_simulate, args=(redis.url(), k, spec, rate / actors), daemon=True)
            for k in range(actors)
        ]
        for process in (*servers, *senders):
            process.start()
        while any(bus.replay_address(Shard(k, shards).role) is None for k in range(shards)):
            time.sleep(0.05)
        assert redis.process is not None
        numbers = {"redis": [redis.process.pid], "replay": [one.pid or 0 for one in servers]}
        yield bus, numbers | {"actor": [one.pid or 0 for one in senders]}
        for process in senders:
            process.kill()
        bus.request_stop("done")
        for process in (*senders, *servers):
            process.join()


def _cpu(numbers: list[int]) -> list[float]:
    return [sum(psutil.Process(number).cpu_times()[:2]) for number in numbers]


def _unused() -> tuple[float, float]:
    """Seconds of all cores that were idle, and that were stolen."""
    machine = psutil.cpu_times()
    return machine.idle + machine.iowait, machine.steal


def _acknowledged(bus: RedisBus, actors: int) -> list[int]:
    """Entries of each actor that are committed."""
    acks = [bus.ack(actor) for actor in range(actors)]
    return [0 if ack is None else ack.id.seq for ack in acks]


def _committed(bus: RedisBus, actors: int) -> int:
    return CHUNK * sum(_acknowledged(bus, actors))


def _pin(numbers: dict[str, list[int]], alone: str) -> None:
    """The first core for one kind of process, the others for the rest."""
    first, *others = sorted(os.sched_getaffinity(0))
    for kind, pids in numbers.items():
        for number in pids:
            for thread in psutil.Process(number).threads():
                os.sched_setaffinity(thread.id, {first} if kind == alone else others)


def measure(spec: WindowSpec, shards: int, actors: int, alone: str, rate: float, seconds: float) -> Point:
    """One load for so many seconds, two after the first commits: loading code and filling Redis take longer."""
    with _system(spec, shards, actors, rate) as (bus, numbers):
        if alone:
            _pin(numbers, alone)
        while not all(_acknowledged(bus, actors)):
            time.sleep(0.05)
        time.sleep(2.0)
        before = {kind: _cpu(pids) for kind, pids in numbers.items()}
        unused = _unused()
        windows, start = _committed(bus, actors), time.perf_counter()
        time.sleep(seconds)
        windows, elapsed = _committed(bus, actors) - windows, time.perf_counter() - start
        idle, stolen = ((now - then) / elapsed for now, then in zip(_unused(), unused, strict=True))
        used = {
            kind: [(after - at) / elapsed for after, at in zip(_cpu(pids), before[kind], strict=True)]
            for kind, pids in numbers.items()
        }
    return Point(
        shards, actors, alone, rate, windows / elapsed,
        used["redis"][0], max(used["replay"]), sum(used["actor"]), idle, stolen,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--actors", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--shards", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--first-rate", type=float, default=2000.0)
    parser.add_argument("--alone", choices=["redis", "replay"], default="", help="what has the first core for itself")
    options = parser.parse_args()
    spec = robust(EnvConfig(options.env)).window_spec()
    path = Path(__file__).parent / "results" / "scaling.jsonl"
    for shards in options.shards:
        rate, kept_up = options.first_rate, True
        while kept_up:
            point = measure(spec, shards, options.actors, options.alone, rate, options.seconds)
            kept_up, rate = point.committed >= KEPT_UP * point.offered, 2 * rate
            facts = {"env": options.env, "window_bytes": spec.dtype.itemsize, **vars(point), "cores": os.cpu_count()}
            with path.open("a") as file:
                file.write(json.dumps(facts) + "\n")
            print(json.dumps(facts))


if __name__ == "__main__":
    main()
