"""Time from a learner's broadcast of 5 MB of weights until the last of 8 actors acts by them.

    python -m benchmarks.weights [--actors 8] [--rounds N]

The learner is a RedisBus in this process, an actor a process that looks as often as one that waits does, and then
fetches, checks and loads as all do. All share the machine's cores with Redis. The limit copies the bytes once an actor.
"""

import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.queues import Queue
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save

from benchmarks import harness
from benchmarks.harness import RUN, compare
from rmc.actors.actor import POLL_SECONDS
from rmc.actors.policy_runner import PolicyRunner
from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.common.bus.protocol import Version
from rmc.common.bus.redis_bus import RedisBus
from rmc.deploy.redis.server import RedisServer

OBS_DIM, ACTION_DIM = 17, 6
AGENT = AgentConfig(hidden=384, embedding=384, heads=(500, 350))  # 5 MB
BROADCASTS = 10  # in a turn, of which the median counts
Loaded = tuple[int, float]  # update, and when it was loaded


def _receive(url: str, loaded: "Queue[Loaded]") -> None:
    """An actor's part: look, fetch, check, load."""
    torch.set_num_threads(1)
    bus, runner, held = RedisBus(url, RUN), PolicyRunner(OBS_DIM, ACTION_DIM, AGENT, envs=8), None
    while bus.stop_requested() is None:
        newest = bus.latest_version()
        if newest is not None and newest != held and (weights := bus.weights()) is not None:
            held, blob = weights
            runner.load(blob)
            loaded.put((held.update, time.monotonic()))
        time.sleep(POLL_SECONDS)


class Broadcast:
    """The learner's end, and what the actors tell of theirs."""

    def __init__(self, bus: RedisBus, loaded: "Queue[Loaded]", actors: int) -> None:
        self._bus, self._loaded, self._actors = bus, loaded, actors
        self.blob: bytes = save(Agent(OBS_DIM, ACTION_DIM, AGENT).policy_weights())
        self._update = 0

    def once(self) -> float:
        """Milliseconds until all actors have the next version."""
        self._update += 1
        start = time.monotonic()
        self._bus.publish_weights(Version(1, self._update), self.blob)
        arrivals = [self._loaded.get() for _ in range(self._actors)]
        assert {update for update, _ in arrivals} == {self._update}
        return 1000.0 * (max(at for _, at in arrivals) - start)

    def median(self) -> float:
        """Of several, each at another moment of the actors' clocks."""
        times = []
        for _ in range(BROADCASTS):
            time.sleep(POLL_SECONDS)
            times.append(self.once())
        return statistics.median(times)

    def copies(self) -> float:
        """Milliseconds for a plain copy of the bytes to each actor's memory."""
        source = np.frombuffer(self.blob, np.uint8)
        targets = [np.zeros_like(source) for _ in range(self._actors)]
        start = time.perf_counter()
        for target in targets:
            np.copyto(target, source)
        return 1000.0 * (time.perf_counter() - start)


@contextmanager
def broadcasting(actors: int) -> Iterator[Broadcast]:
    """Redis, and actors that have had a first broadcast."""
    spawn = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder, RedisServer(Path(folder)) as redis:
        bus, loaded = RedisBus(redis.url(), RUN), spawn.Queue()
        receivers = [spawn.Process(target=_receive, args=(redis.url(), loaded)) for _ in range(actors)]
        for process in receivers:
            process.start()
        broadcast = Broadcast(bus, loaded, actors)
        broadcast.once()
        yield broadcast
        bus.request_stop("done")
        for process in receivers:
            process.join()


def main() -> None:
    parser = harness.argument_parser(__doc__)
    parser.add_argument("--actors", type=int, default=8)
    options = parser.parse_args()
    with broadcasting(options.actors) as broadcast:
        name = f"weights, {len(broadcast.blob) / 1e6:.1f} MB to {options.actors} actors"
        limit = (f"{options.actors} plain copies", broadcast.copies)
        harness.save(compare(name, "ms", broadcast.median, {}, limit, options.rounds, less_is_better=True))


if __name__ == "__main__":
    main()
