"""kill -9 of an actor under load: ``python -m tests.faults.kill_actor [--tries 50]``."""

import random
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tests.faults.judge import opened, rows_of
from tests.faults.loaded import ACTORS, Loaded
from tests.faults.row import Row, at_length

RECOVERY_S = 3.0


def kill_actors(tries: int, folder: Path) -> Iterator[Row]:
    """One or the other so often, amid whatever it does."""
    chance, slowest = random.Random(0), 0.0
    with Loaded(folder / "run") as run:
        run.begin()
        for _ in range(tries):
            time.sleep(chance.uniform(0.2, 1.5))
            slowest = max(slowest, run.kill(f"actor-{chance.randrange(ACTORS)}"))
        run.until_all_go_on()
        verdict = run.end()
    repeated = _repeated_starts(folder / "run")
    passed = not repeated and slowest < RECOVERY_S
    yield Row.judged("kill -9 of an actor", tries, passed, verdict, slowest, {"repeated_episodes": repeated})


def _repeated_starts(folder: Path) -> int:
    """Episodes that begin with an observation which another one began with."""
    with opened(folder) as store:
        rows = rows_of(store)
    begun = rows[rows["episode_step"] == 0]
    first = begun["observation"][np.arange(len(begun)), begun["first"]]
    return len(first) - len(np.unique(first, axis=0))


if __name__ == "__main__":
    at_length(__doc__, kill_actors, tries=50)
