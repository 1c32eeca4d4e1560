"""Replay under mixed load on one core: batches drawn by priority, their priorities back, windows coming in.

    python -m benchmarks.replay [--env HalfCheetah-v5 Humanoid-v5] [--rounds 5] [--seconds 4]

Of each batch the learner's side makes per-field arrays and importance weights. All processes of a side share one core,
the last one, and each side has it to itself in its turn. Ours is the product with everything on.
"""

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection

import numpy as np
import psutil
import torch

from benchmarks.harness import (
    RUN,
    SECRET,
    Measure,
    Row,
    argument_parser,
    compare,
    random_rows,
    replay_process,
    running,
    save,
    started_peer,
)
from benchmarks.peers.turns import send_at, speed
from benchmarks.sender import CHUNK, Sender
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.env.config import EnvConfig
from rmc.common.env.make import env_layout
from rmc.common.replay import SampleStatus
from rmc.common.window import WindowSpec
from rmc.learner.batch import Batch, clear_padding, importance_weights, view_batch
from rmc.learner.config import LearnerConfig
from rmc.learner.replay.client import ReplayClient
from rmc.replay_server.config import ReplayConfig

BATCH = 256
RATE = 500  # windows a second that come in
KEPT_UP = 0.95  # of what comes in, or the turn does not count
WINDOWS = {"HalfCheetah-v5": 20_000, "Humanoid-v5": 4_000}  # in the ring
HIDDEN = 256
SETTLE = 0.2  # seconds that windows come in beyond a turn
REVERB = {  # where its server is, and how a window is laid out
    "Reverb, server of its own": ("server", "fields"),
    "Reverb, server of its own, packed windows": ("server", "packed"),
    "Reverb, server in the learner": ("learner", "fields"),
    "Reverb, server in the learner, packed windows": ("learner", "packed"),
}
IN_FLIGHT = 256  # samples, and below where another number was faster
IN_FLIGHT_OF = {("Humanoid-v5", "server", "packed"): 16, ("Humanoid-v5", "learner", "packed"): 64}


def _send(url: str, spec: WindowSpec, windows: int, orders: Connection) -> None:
    """Fill the ring, then for each order, seconds, send at the rate; answer by what came of it."""
    sender = Sender(RedisBus(url, RUN), spec)
    for _ in range(windows // CHUNK):
        sender.wait(64)
        sender.send()
    sender.wait()
    orders.send(0.0)
    while True:
        orders.send(send_at(RATE, CHUNK, orders.recv(), sender.send))


class Learner:
    """The learner's side of ours: all that happens to a batch but the update."""

    def __init__(self, bus: RedisBus, spec: WindowSpec) -> None:
        self.spec, self.env_steps, self.batch = spec, 0, None
        self.client = ReplayClient(lambda: bus.replay_address("replay"), SECRET, spec, BATCH)
        self._random, self._exponent = np.random.default_rng(0), LearnerConfig().importance_exponent

    def step(self) -> int:
        """One batch, its priorities sent back."""
        sample = self.client.sample(BATCH)
        assert sample.status is SampleStatus.BATCH
        assert sample.rows is not None
        assert sample.weights is not None
        self.env_steps = sample.env_steps
        weights = importance_weights(sample.weights, self._exponent)
        clear_padding(sample.rows, self.spec)
        raw = torch.from_numpy(sample.rows.view("u1").reshape(BATCH, -1))
        self.batch: Batch = view_batch(raw, torch.from_numpy(weights), self.spec)
        priorities = self._random.uniform(0.1, 1.0, BATCH).astype(np.float32)
        self.client.update_priorities(sample.rows["serial"].copy(), priorities)
        return 1


@contextmanager
def ours(spec: WindowSpec, windows: int, seconds: float) -> Iterator[Measure]:
    """Batches a second of the product, its processes stopped outside of their turns."""
    config = ReplayConfig(capacity=windows, replay_ratio=1e9, warmup_steps=0)
    spawn = multiprocessing.get_context("spawn")
    orders, theirs = spawn.Pipe()
    with replay_process(spec, config) as bus:
        sender = spawn.Process(target=_send, args=(bus.url, spec, windows, theirs), daemon=True)
        sender.start()
        orders.recv()
        learner, processes = Learner(bus, spec), psutil.Process().children(recursive=True)

        def measure() -> float:
            with running(processes):
                orders.send(seconds + 2 * SETTLE)
                speed(learner.step, SETTLE)
                before, start = learner.env_steps, time.perf_counter()
                rate = speed(learner.step, seconds)
                committed = (learner.env_steps - before) / spec.train / (time.perf_counter() - start)
                assert min(orders.recv(), committed) > KEPT_UP * RATE, committed
                return rate

        try:
            yield measure
        finally:
            learner.client.close()
            sender.kill()


def gather(spec: WindowSpec, windows: int, seconds: float) -> Measure:
    """Batches a second of whole rows at random out of as many in memory, by numpy: the ceiling."""
    rows = random_rows(spec, windows).view(np.dtype((np.void, spec.dtype.itemsize)))
    random = np.random.default_rng(0)

    def once() -> int:
        rows[random.integers(windows, size=BATCH)]
        return 1

    return lambda: speed(once, seconds)


def measure(env_id: str, rounds: int, seconds: float) -> list[Row]:
    """Windows of one environment."""
    spec, windows, core = spec_of(env_id), WINDOWS[env_id], max(os.sched_getaffinity(0))
    sizes = core, spec.obs_dim, spec.action_dim, spec.state, windows, BATCH, RATE, CHUNK
    with ExitStack() as stack:
        own = stack.enter_context(ours(spec, windows, seconds))
        peers: dict[str, Measure | None] = {}
        for name, (place, layout) in REVERB.items():
            in_flight = IN_FLIGHT_OF.get((env_id, place, layout), IN_FLIGHT)
            words = place, layout, in_flight, *sizes
            peers[name] = started_peer(stack, "reverb", "reverb_replay", seconds, *words)
        peers["cpprb, in the learner"] = started_peer(stack, "peers", "cpprb_replay", seconds, *sizes)
        limit = ("numpy gather in memory", gather(spec, windows, seconds))
        return compare(f"replay, mixed load, batch {BATCH}, {env_id}", "batches/s", own, peers, limit, rounds)


def spec_of(env_id: str) -> WindowSpec:
    """Its windows; making it tells their sizes."""
    layout = env_layout(EnvConfig(env_id))
    return WindowSpec(layout.obs_dim, layout.action_dim, HIDDEN)


def measure_each(doc: str | None, measure: Callable[[str, int, float], list[Row]]) -> None:
    """The command line: each of the environments."""
    parser = argument_parser(doc)
    parser.add_argument("--env", nargs="+", choices=list(WINDOWS), default=list(WINDOWS))
    options = parser.parse_args()
    for env_id in options.env:
        save(measure(env_id, options.rounds, options.seconds))


if __name__ == "__main__":
    torch.set_num_threads(1)
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    measure_each(__doc__, measure)
