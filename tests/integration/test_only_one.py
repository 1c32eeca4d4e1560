"""An environment that can exist once: it is trained, and what makes more of them says how."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from rmc.actors.config import EvaluatorConfig
from rmc.cli import main
from rmc.common.env.config import EnvConfig
from rmc.deploy.local.launcher import commands
from rmc.deploy.ray.placement import places
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.presets import debug
from rmc.deploy.run.validation import validate
from tests.integration.running import ENVIRONMENT, Training

ENV = "tests.only_one_env:OnlyOne-v0"
ONE = ("--actors", "1", "--envs-per-actor", "1", "--episodes", "0")


@pytest.fixture(autouse=True)
def lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RMC_TEST_LOCK", str(tmp_path / "lock"))
    monkeypatch.setattr(
        "tests.integration.running.ENVIRONMENT", {**ENVIRONMENT, "RMC_TEST_LOCK": str(tmp_path / "lock")}
    )


@pytest.mark.parametrize("launcher", ["local", "lockstep"])
def test_it_is_trained(tmp_path: Path, launcher: str) -> None:
    options = ("--total-steps", "700", "--checkpoint-steps", "600", "--launcher", launcher)
    with Training(tmp_path / "run", *options, *ONE, env=ENV) as training:
        assert training.finish(170) == 0, training.text() + training.logs()
    result = json.loads((tmp_path / "run" / "result.json").read_bytes())
    assert (result["env_steps"] >= 700, result["eval_episodes"]) == (True, 10)
    assert main.run(["evaluate", str(tmp_path / "run")]) == 0


@pytest.mark.parametrize("episodes", [0, 1])
def test_without_episodes_there_is_no_evaluator(tmp_path: Path, episodes: int) -> None:
    config = replace(debug(EnvConfig("Pendulum-v1")), evaluator=EvaluatorConfig(episodes=episodes))
    validate(config)
    local = [command.name for command in commands(config, RunFolder(tmp_path), tmp_path, "cpu")]
    for names in (config.roles(), local, list(places(config, "run", "cpu", encrypted=False))):
        assert ("evaluator" in names) is (episodes > 0)
        assert {"learner", "actor-0"} <= set(names)


@pytest.mark.parametrize(
    ("left_out", "what"),
    [
        (2, "an environment of actor-0's 2"),
        pytest.param(4, "(the evaluator's environment|an environment of actor-0's 1)", marks=pytest.mark.long),
    ],
)
def test_who_makes_a_second_one_says_what_to_do(tmp_path: Path, left_out: int, what: str) -> None:
    """Of the evaluator and the actor, whichever comes second."""
    options = [*ONE]
    options[left_out + 1] = "2"
    with Training(tmp_path / "run", "--total-steps", "100000", *options, env=ENV) as training:
        assert training.finish(170) == 1
    assert re.search(rf"{what} cannot be made beside the others \(BlockingIOError: ", training.text())
    assert "take --actors 1 --envs-per-actor 1 --episodes 0" in training.text()


def test_check_env_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.run(["check-env", ENV, "--steps", "100"]) == 0
    output = capsys.readouterr().out
    assert "note: no second one can be beside it (BlockingIOError: " in output
    assert "take --actors 1 --envs-per-actor 1 --episodes 0" in output
    assert main.run(["check-env", "tests.counting_env:Counting-v0", "--steps", "100"]) == 0
    assert "no second one" not in capsys.readouterr().out
