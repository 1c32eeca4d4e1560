"""kill -9 of a whole run at once, then ``rmc train`` again: ``python -m tests.faults.kill_all [--tries 5]``."""

import random
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rmc.common.checkpoint import CheckpointFolder
from tests.faults.judge import Acks, judge, opened
from tests.faults.loaded import ROOMY, Loaded
from tests.faults.row import Row, at_length
from tests.faults.witness import went_back

RECOVERY_S = 30.0  # from ``rmc train`` on; a run's own start
OFTEN = (*ROOMY, "--checkpoint-steps", "500")
COUNTED = ("env_steps", "windows", "drawn_steps", "draws")  # beta's clock is the first
Kept = dict[str, float]


def kill_everything(tries: int, folder: Path) -> Iterator[Row]:
    """So often, each time going on in the same folder."""
    chance, slowest, less = random.Random(0), 0.0, 0
    place, acks, versions = folder / "run", Acks(), []
    reported: Kept = {}
    left: Kept = {}
    for _ in range(tries + 1):
        began = time.monotonic()
        with Loaded(place, *OFTEN) as run:
            run.witness.acks = acks  # of all lives
            run.begin()
            run.until_all_go_on()
            slowest = max(slowest, time.monotonic() - began)
            run.until(lambda run=run: CheckpointFolder(run.folder / "checkpoints").numbers())
            time.sleep(chance.uniform(1.0, 3.0))
            reported = {name: run.newest("replay", name) for name in COUNTED}
            run.kill_all()
        versions += run.witness.versions
        before, left = left, on_disk(place)
        less += sum(left[name] < reported[name] for name in reported) + sum(
            left[name] < before[name] for name in before
        )
    verdict = judge(place, acks)
    differs = sum(not one["same"] for one in run.events("resumed"))
    table = {name: f"{reported.get(name, '-')} said last, {left[name]} on disk" for name in left}
    passed = not (less or differs or went_back(versions)) and slowest < RECOVERY_S
    facts = {"learner_state_differs": differs, "counters_fell": less, **table}
    yield Row.judged("kill -9 of every process at once", tries, passed, verdict, slowest, facts)


def on_disk(place: Path) -> Kept:
    """What the next start goes on with."""
    with opened(place) as store:
        progress, checkpoint = store.ring.progress, CheckpointFolder(place / "checkpoints").latest()
    learnt = store.priorities[: progress.next_serial] != 1.0
    return {
        "env_steps": progress.env_steps,
        "windows": progress.next_serial,
        "drawn_steps": progress.drawn_steps,
        "draws": progress.draws,
        "normaliser's observations": int(progress.observed.count[0]),
        "priorities learnt": int(np.count_nonzero(learnt)),
        "learner's update": checkpoint[0] if checkpoint is not None else 0,
    }


if __name__ == "__main__":
    at_length(__doc__, kill_everything, tries=5)
