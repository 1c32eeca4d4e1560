"""A run whose update has two processes."""

import json
import os
import signal
from pathlib import Path

import psutil
import pytest

from rmc.common.checkpoint import CheckpointFolder
from rmc.learner.config import MODEL_PROCESS
from tests.integration.running import Training
from tests.processes import alive, matching

pytestmark = pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one core: the update has one process")


def halves(training: Training) -> list[psutil.Process]:
    """The processes of the model's half."""
    return list(matching(MODEL_PROCESS, training.launcher.children(recursive=True)))


@pytest.mark.long  # tests/learner/test_pipelined_update.py has what a half does whose other one ends
def test_it_survives_the_death_of_each_half_and_goes_on(tmp_path: Path) -> None:
    options = ("--scheme", "3", "--checkpoint-steps", "300")
    with Training(tmp_path / "run", "--total-steps", "100000", *options) as training:
        training.wait_for_updates()
        for victim in ("model", "value"):
            training.wait_for(lambda: len(halves(training)) == 1)
            (model,), learner = halves(training), training.role("learner")
            restarts = training.newest("launcher", "restarts")
            assert learner is not None
            (model if victim == "model" else learner).kill()
            training.wait_for(lambda before=restarts: training.newest("launcher", "restarts") > before)
            training.wait_for_updates(20)
            assert not alive([model, learner])
        everything = training.launcher.children(recursive=True)
        training.process.send_signal(signal.SIGINT)
        assert training.finish(60) == 130
        assert not alive(everything)
    number, files = CheckpointFolder(tmp_path / "run" / "checkpoints").latest() or (0, {})
    steps = json.loads(files["progress.json"])["env_steps"] + 500
    with Training(tmp_path / "run", "--total-steps", str(steps), *options, "--threads", "1") as training:
        training.wait_for(lambda: training.newest("learner", "updates") > number)
        assert not halves(training)
        assert training.finish(120) == 0, training.text()
    assert "has ended; the lines above say why" in (tmp_path / "run" / "logs" / "learner.log").read_text()
