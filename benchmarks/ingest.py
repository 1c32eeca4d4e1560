"""Ingest: windows a second from an actor's rows to a replay server that has them for good.

    python -m benchmarks.ingest [--env HalfCheetah-v5 Humanoid-v5] [--rounds 5] [--seconds 4]

The sender has the first core; Redis and the replay server, or the peer's server, share the last one. Ours counts what
is committed to the ring and acknowledged.
"""

import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np
import psutil

from benchmarks.harness import (
    ENDLESS,
    Measure,
    Row,
    compare,
    random_rows,
    replay_process,
    running,
    started_peer,
)
from benchmarks.peers.turns import speed
from benchmarks.replay import WINDOWS, measure_each, spec_of
from benchmarks.sender import CHUNK, Sender
from rmc.common.window import WindowSpec
from rmc.replay_server.config import ReplayConfig

BEHIND = 256  # entries sent ahead of what is acknowledged
LAYOUTS = {"Reverb": "fields", "Reverb, packed windows": "packed"}


@contextmanager
def ours(spec: WindowSpec, windows: int, seconds: float) -> Iterator[Measure]:
    """The product, its processes stopped outside of their turns."""
    with replay_process(spec, ReplayConfig(capacity=windows, warmup_steps=ENDLESS)) as bus:
        sender, processes = Sender(bus, spec), psutil.Process().children(recursive=True)

        def one() -> int:
            sender.send()
            sender.wait(BEHIND)
            return CHUNK

        def measure() -> float:
            with running(processes):
                speed(one, 0.5)
                sender.wait()
                first, start = sender.seq, time.perf_counter()
                speed(one, seconds)
                sender.wait()
                return (sender.seq - first) * CHUNK / (time.perf_counter() - start)

        yield measure


def copy(spec: WindowSpec, seconds: float) -> Measure:
    """The same rows copied once in memory: the ceiling."""
    rows, target = random_rows(spec, 4096), np.zeros(4096, spec.dtype)

    def once() -> int:
        np.copyto(target, rows)
        return len(rows)

    return lambda: speed(once, seconds / 4)


def measure(env_id: str, rounds: int, seconds: float) -> list[Row]:
    """Windows of one environment."""
    spec, cores = spec_of(env_id), sorted(os.sched_getaffinity(0))
    words = cores[0], cores[-1], spec.obs_dim, spec.action_dim, spec.state, WINDOWS[env_id], CHUNK
    with ExitStack() as stack:
        own = stack.enter_context(ours(spec, WINDOWS[env_id], seconds))
        peers = {
            name: started_peer(stack, "reverb", "reverb_ingest", seconds, columns, *words)
            for name, columns in LAYOUTS.items()
        }
        limit = ("one copy in memory", copy(spec, seconds))
        return compare(f"ingest, {CHUNK} windows an entry, {env_id}", "windows/s", own, peers, limit, rounds)


if __name__ == "__main__":
    measure_each(__doc__, measure)
