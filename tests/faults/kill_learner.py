"""kill -9 of the learner, at random and amid saving: ``python -m tests.faults.kill_learner [--tries 20]``."""

import random
import time
from collections.abc import Iterator
from pathlib import Path

from rmc.common.checkpoint import CheckpointFolder
from tests.faults.loaded import ROOMY, Loaded
from tests.faults.row import Row, at_length
from tests.faults.witness import went_back

RECOVERY_S = 15.0
POINTS = ("half-a-checkpoint", "synchronised", "saved")
OFTEN = (*ROOMY, "--checkpoint-steps", "500")


def kill_learners(tries: int, folder: Path) -> Iterator[Row]:
    """So often, each third one amid a checkpoint."""
    chance, slowest = random.Random(0), 0.0
    with Loaded(folder / "run", *OFTEN) as run:
        run.begin()
        run.until(lambda: CheckpointFolder(run.folder / "checkpoints").numbers())
        for number in range(tries):
            time.sleep(chance.uniform(0.2, 1.5))
            point = POINTS[number // 3 % len(POINTS)]
            slowest = max(slowest, run.strike(point, "learner") if number % 3 == 0 else run.kill("learner"))
            run.until_all_go_on()
        resumed = run.events("resumed")
        verdict = run.end()
    facts = {
        "resumed": len(resumed),
        "state_differs": sum(not one["same"] for one in resumed),
        "weights_went_back": went_back(run.witness.versions),
    }
    passed = not (facts["state_differs"] or facts["weights_went_back"])
    passed = passed and len(resumed) >= tries and slowest < RECOVERY_S
    yield Row.judged("kill -9 of the learner", tries, passed, verdict, slowest, facts)


if __name__ == "__main__":
    at_length(__doc__, kill_learners, tries=20)
