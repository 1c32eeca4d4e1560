"""kill -9 of an actor under load: ``python -m tests.faults.kill_actor [--tries 50]``."""

import argparse
import random
import tempfile
import time
from pathlib import Path

import numpy as np

from deploy.run_folder import RunFolder
from replay_server.recovery import open_store
from tests.faults.loaded import ACTORS, Loaded
from tests.faults.row import Row

RECOVERY_S = 3.0


def kill(tries: int, folder: Path, seed: int = 0) -> Row:
    """Kill one or the other so often."""
    chance, slowest = random.Random(seed), 0.0
    with Loaded(folder) as run:
        run.begin()
        for _ in range(tries):
            name = f"actor-{chance.randrange(ACTORS)}"
            victim, epoch = run.process_of(name), run.bus.current_epoch(name)
            time.sleep(chance.uniform(0.2, 1.5))
            victim.kill()
            slowest = max(slowest, run.until(lambda name=name, epoch=epoch: run.bus.current_epoch(name) > epoch))
        acked = dict(run.acks)
        for actor in range(ACTORS):  # each goes on
            before = _of_actor(acked, actor)
            run.until(lambda actor=actor, before=before: _of_actor(run.acks, actor) != before)
        found = run.end()
    repeated = _repeated_starts(folder)
    passed = not (found.lost or found.duplicated or repeated) and slowest < RECOVERY_S
    return Row(
        "kill -9 of an actor", tries, passed, found.acknowledged, found.lost, found.duplicated, round(slowest, 2),
        {"repeated_episodes": repeated},
    )  # fmt: skip


def _of_actor(acks: dict[tuple[int, int], int], actor: int) -> dict[tuple[int, int], int]:
    return {life: seq for life, seq in acks.copy().items() if life[0] == actor}


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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tries", type=int, default=50)
    with tempfile.TemporaryDirectory(prefix="rmc-fault-") as place:
        row = kill(parser.parse_args().tries, Path(place) / "run")
    row.keep()
