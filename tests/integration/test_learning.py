"""It learns: a task that only a memory solves, and a pendulum balanced to the time limit."""

import time
from pathlib import Path

import pytest

from rmc.analysis.evaluation import evaluate_policy
from rmc.analysis.policy_file import read_policy
from rmc.deploy.run.folder import RunFolder
from tests.integration.running import DATA, FAST, SMALL, Training
from tests.memory_env import SOLVED_RETURN

SECONDS = 600.0
pytestmark = pytest.mark.timeout(SECONDS + 30)


@pytest.mark.long
def test_one_actor_and_one_learner_balance_the_pendulum(tmp_path: Path) -> None:
    pace = ["--total-steps", "8000", "--replay-ratio", "240", "--alpha-learning-rate", "1e-3"]
    assert best_return(tmp_path / "run", "InvertedPendulum-v5", pace, 1000.0) == 1000.0


def test_a_cue_is_remembered_over_twelve_steps(tmp_path: Path) -> None:
    pace = ["--total-steps", "8000", "--replay-ratio", "32", "--alpha-learning-rate", "5e-3", "--launcher", "lockstep"]
    assert best_return(tmp_path / "run", "tests.memory_env:Memory12-v0", pace, SOLVED_RETURN + 0.2) > SOLVED_RETURN


def best_return(folder: Path, env: str, pace: list[str], enough: float) -> float:
    """Mean return of a run's best checkpoint over ten deterministic episodes; the run ends once it has ``enough``."""
    with Training(folder, *SMALL, *FAST, *DATA, *pace, env=env) as training:
        deadline = time.monotonic() + SECONDS
        while (
            training.process.poll() is None and training.newest("evaluator", "eval_return_mean", -1e9) <= enough - 1e-6
        ):
            assert time.monotonic() < deadline, training.text() + training.logs()
            time.sleep(1.0)
        training.interrupt()
    run = RunFolder(folder)
    return float(evaluate_policy(read_policy(run.path, "best"), 10)["eval_return_mean"])
