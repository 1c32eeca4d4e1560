"""A loss that is no number, forced, under load: ``python -m tests.faults.nan_loss [--tries 5]``."""

import dataclasses
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from rmc.common.checkpoint import STATE, CheckpointFolder
from rmc.deploy.local.role_process import QUICK_DEATHS
from tests.faults.judge import Judgement, judge
from tests.faults.loaded import ROOMY, Loaded
from tests.faults.row import Row, at_length
from tests.faults.witness import went_back

RECOVERY_S = 15.0
CAUSE = "training has diverged, weights are not finite"


def force_nan(tries: int, folder: Path) -> Iterator[Row]:
    """In so many runs twice: the learner ends with the cause, and goes on from its last checkpoint, which is sound.

    Then once more, too soon: the run ends with the cause.
    """
    slowest, facts = 0.0, {"causes_said": 0, "checkpoints_spoilt": 0, "weights_went_back": 0}
    verdicts = []
    for number in range(tries):
        with Loaded(folder / f"run-{number}", *ROOMY, "--checkpoint-steps", "500") as run:
            run.begin()
            checkpoints = CheckpointFolder(run.folder / "checkpoints")
            run.until(checkpoints.numbers)
            slowest = max(slowest, *(_once(run) for _ in range(QUICK_DEATHS - 1)))
            run.arm("nan")
            status = run.process.wait(60)
            text = run.text()
        verdicts.append(dataclasses.astuple(judge(run.folder, run.witness.acks)))
        log = (run.folder / "logs" / "learner.log").read_text()
        facts["causes_said"] += log.count(CAUSE) // QUICK_DEATHS + (status == 1 and CAUSE in text)
        facts["checkpoints_spoilt"] += sum(not _sound(checkpoints.load(one)) for one in checkpoints.numbers())
        facts["weights_went_back"] += went_back(run.witness.versions)
    passed = facts == {"causes_said": 2 * tries, "checkpoints_spoilt": 0, "weights_went_back": 0}
    total = Judgement(*map(sum, zip(*verdicts, strict=True)))
    yield Row.judged("NaN in a loss", QUICK_DEATHS * tries, passed and slowest < RECOVERY_S, total, slowest, facts)


def _once(run: Loaded) -> float:
    """How long until it is back."""
    epoch = run.bus.current_epoch("learner")
    run.arm("nan")
    run.until(lambda: not (run.armed / "nan").exists())
    back = run.until(lambda: run.bus.current_epoch("learner") > epoch)
    run.until_all_go_on()
    return back


def _sound(files: dict[str, bytes]) -> bool:
    return _finite(torch.load(io.BytesIO(files[STATE]), weights_only=True))


def _finite(state: Any) -> bool:
    if isinstance(state, dict):
        return all(map(_finite, state.values()))
    if isinstance(state, (list, tuple)):
        return all(map(_finite, state))
    return not isinstance(state, torch.Tensor) or bool(state.isfinite().all())


if __name__ == "__main__":
    at_length(__doc__, force_nan, tries=5)
