"""How the system grows: each size twice the one before, its speed, and the log-log slope between them.

    python -m benchmarks.growth [actors] [batch] [ring] [window] [--seconds S] [--rounds N]

A slope of 1 is in proportion, of 0 is no change. Actors are the simulated ones of ``benchmarks.scaling``, each of which
offers 1 000 windows a second, more than a real one; they share the machine's cores with Redis and one replay server.
"""

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from benchmarks import harness
from benchmarks.harness import Row, compare, random_rows
from benchmarks.learner import learner_role, replay_of
from benchmarks.peers.turns import speed
from benchmarks.scaling import measure
from rmc.common.env.config import EnvConfig
from rmc.common.window import WindowSpec
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.presets import robust
from rmc.replay_server.recovery import open_store

ENV = EnvConfig("HalfCheetah-v5")
SMALL = WindowSpec(obs_dim=4, action_dim=1, state=8, burn_in=2, train=3)  # a million of them fit the memory
DRAWN = 256  # windows, of the ring
OFFERED = 1_000.0  # windows a second, by each simulated actor
Table = list[tuple[int, Row]]  # size, its measurement


def actors(rounds: int, seconds: float) -> Table:
    """Windows a second committed."""
    spec = robust(ENV).window_spec()

    def committed(count: int) -> Callable[[], float]:
        return lambda: measure(spec, 1, count, "", count * OFFERED, seconds).committed

    sizes = (1, 2, 4, 8, 16, 32)
    return [(n, compare(f"growth, {n} actors", "windows/s", committed(n), {}, rounds=rounds)[0]) for n in sizes]


def batch(rounds: int, seconds: float) -> Table:
    """Trained steps a second."""
    run, sizes = robust(ENV), (32, 64, 128, 256, 512)
    return [(size, _learning(f"growth, batch {size}", run, size, rounds, seconds)) for size in sizes]


def window(rounds: int, seconds: float) -> Table:
    """Trained steps a second at the default batch."""
    run, table = robust(ENV), []
    for steps in (25, 100, 250, 1_000):
        longer = replace(run, window=replace(run.window, trained_steps=steps - run.window.burn_in))
        name = f"growth, windows of {steps} steps"
        table.append((steps, _learning(name, longer, run.learner.batch_size, rounds, seconds)))
    return table


def ring(rounds: int, seconds: float) -> Table:
    """A draw's microseconds: sum tree and gather, then new priorities."""
    table: Table = []
    for capacity in (10_000, 32_000, 100_000, 320_000, 1_000_000):
        with tempfile.TemporaryDirectory() as folder:
            draw = _filled(Path(folder), capacity)
            speed(draw, 0.5)
            name = f"growth, draw and priorities of {DRAWN} of {capacity} windows"
            table.append((capacity, compare(name, "us", lambda d=draw: 1e6 / speed(d, seconds), {}, rounds=rounds)[0]))  # type: ignore[misc]
    return table


def _filled(folder: Path, capacity: int) -> Callable[[], int]:
    """A full ring, of which each call draws and gives priorities back."""
    store, rng = open_store(folder, SMALL, capacity, exponent=0.6), np.random.default_rng(0)
    rows = random_rows(SMALL, capacity)
    store.set_priorities(store.ring.write(rows), rng.uniform(0.1, 1.0, capacity).astype(np.float32))
    store.ring.commit(capacity)
    out, priorities = np.zeros(DRAWN, SMALL.dtype), rng.uniform(0.1, 1.0, DRAWN).astype(np.float32)

    def draw() -> int:
        slots = store.tree.sample(DRAWN, rng)
        store.ring.gather(slots, out)
        store.set_priorities(slots, priorities)
        return 1

    return draw


def _learning(name: str, run: RunConfig, size: int, rounds: int, seconds: float) -> Row:
    """The whole role on one core: trained steps a second."""
    with replay_of(run) as bus, learner_role(run, bus, size, "auto") as role:

        def work() -> int:
            return size * run.window.trained_steps * int(role.step())

        speed(work, 1.0)
        return compare(f"{name}, trained", "steps/s", lambda: speed(work, seconds), {}, rounds=rounds)[0]


def slope(of: str, table: Table) -> Row:
    """Over all sizes, and at which size the slope from one to the next bends most."""
    points = [(math.log(size), math.log(row.ours)) for size, row in table]
    steps = [(v - y) / (u - x) for (x, y), (u, v) in pairwise(points)]
    bends = [abs(after - before) for before, after in pairwise(steps)]
    whole = (points[-1][1] - points[0][1]) / (points[-1][0] - points[0][0])
    name, bend = f"growth, slope of {table[0][1].unit} over {of}", float(table[1 + int(np.argmax(bends))][0])
    spread: dict[str, tuple[float, float | None]] = {"ours": (min(steps), max(steps))}
    return Row(name, "", whole, "", None, None, bend, "bends most at", spread, table[0][1].rounds, harness.command())


def main() -> None:
    tables = {"actors": actors, "batch": batch, "ring": ring, "window": window}
    parser = harness.argument_parser(__doc__)
    parser.add_argument("what", nargs="*", default=list(tables), help=", ".join(tables))
    options = parser.parse_args()
    if unknown := set(options.what) - set(tables):
        parser.error(f"{', '.join(sorted(unknown))}: take some of {', '.join(tables)}")
    torch.set_num_threads(1)
    for name in options.what:
        table = tables[name](options.rounds, options.seconds)
        harness.save([*(row for _, row in table), slope(name, table)])


if __name__ == "__main__":
    main()
