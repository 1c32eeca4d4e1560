"""kill -9 of an actor under load: ``python -m tests.faults.kill_actor [--tries 50]``."""

import random
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rmc.deploy.run.folder import RunFolder
from rmc.replay_server.recovery import open_store
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
    passed = not (verdict.lost or verdict.duplicated or repeated) and slowest < RECOVERY_S
    yield Row(
        "kill -9 of an actor", tries, passed, verdict.acknowledged, verdict.lost, verdict.duplicated, round(slowest, 2),
        {"repeated_episodes": repeated},
    )  # fmt: skip


def _repeated_starts(folder: Path) -> int:
    """Episodes that begin with an observation which another one began with."""
    run = RunFolder(folder)
    config = run.config()
    store = open_store(run.replay, config.window_spec(), config.replay.capacity, config.replay.priority_exponent)
    progress = store.ring.progress
    rows = store.ring.rows[np.arange(progress.valid_from, progress.next_serial) % store.ring.capacity]
    begun = rows[rows["episode_step"] == 0]
    first = begun["observation"][np.arange(len(begun)), begun["first"]]
    store.close()
    return len(first) - len(np.unique(first, axis=0))


if __name__ == "__main__":
    at_length(__doc__, kill_actors, tries=50)
