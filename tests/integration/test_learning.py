"""It learns: a pendulum balanced to the time limit, and a task that only a memory solves."""

from pathlib import Path

from deploy.run_folder import RunFolder
from tests.integration.running import Training
from tests.memory_env import SOLVED_RETURN

SMALL = ["--preset", "debug", "--precision", "fp32", "--hidden", "64", "--embedding", "64", "--heads", "128", "128"]
FAST = [
    "--learning-rate",
    "5e-4",
    "--polyak",
    "0.99",
    "--warmup-steps",
    "1000",
    "--capacity",
    "5000",
    "--batch-size",
    "16",
]


def test_one_actor_and_one_learner_balance_the_pendulum(tmp_path: Path) -> None:
    options = [*SMALL, *FAST, "--total-steps", "8000", "--replay-ratio", "240", "--alpha-learning-rate", "1e-3"]
    assert trained_return(tmp_path / "run", "InvertedPendulum-v5", options) == 1000.0


def test_a_cue_is_remembered_over_twelve_steps(tmp_path: Path) -> None:
    options = [*SMALL, *FAST, "--total-steps", "8000", "--replay-ratio", "32", "--alpha-learning-rate", "5e-3"]
    assert trained_return(tmp_path / "run", "tests.memory_env:Memory12-v0", options) > SOLVED_RETURN


def trained_return(folder: Path, env: str, options: list[str]) -> float:
    """Mean return of the last checkpoint over ten deterministic episodes, after a whole ``rmc train``."""
    with Training(folder, *options, env=env) as training:
        assert training.finish(600) == 0, training.text() + training.logs()
    result = RunFolder(folder).result()
    assert result is not None
    assert result["eval_episodes"] == 10
    return float(result["eval_return_mean"])
