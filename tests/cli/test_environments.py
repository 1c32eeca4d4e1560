"""What every command says and does of a user's own environment."""

import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box

from rmc.analysis.policy import load_policy
from rmc.cli import main, parser, train_options
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import to_json
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import open_run
from rmc.deploy.run.presets import debug
from tests import habits
from tests.command import complaint
from tests.runs import AGENTS, make_run, read_config, untrained

WANTS = "tests.habits:Wants-v0"
SLIDE = "tests.habits:Slide-v0"


def wanting_run(folder: Path) -> RunFolder:
    return make_run(folder, AGENTS["robust"], WANTS, env_kwargs={"goal": 1.5, "size": 4})


def test_keywords_go_from_the_command_line_into_config_json() -> None:
    command = parser.parse(["train", WANTS, "--env-kwargs", "goal=1.5", "size=4", "name=hall", "--seed", "3"])
    assert isinstance(command, train_options.Train)
    config = command.config()
    assert config.env.env_kwargs == {"goal": 1.5, "size": 4, "name": "hall"}
    assert json.loads(to_json(config))["env"]["env_kwargs"] == config.env.env_kwargs
    assert read_config(to_json(config)) == config


def test_every_command_makes_the_environment_with_its_keywords(tmp_path: Path, capsys: Any) -> None:
    assert main.run(["check-env", WANTS, "--env-kwargs", "goal=1.5", "size=4", "--steps", "50"]) == 0
    assert "observations 4, actions 2" in capsys.readouterr().out
    run = wanting_run(tmp_path / "run")
    assert main.run(["evaluate", str(run.path), "--episodes", "1"]) == 0
    assert load_policy(run.path).make_env().unwrapped.goal == 1.5  # type: ignore[attr-defined]
    assert main.run(["inspect", str(run.path), "--out", str(tmp_path / "a.png")]) == 0


@pytest.mark.parametrize("command", ["check-env", "train"])
@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "missing a required argument: 'goal'"),
        (["--env-kwargs", "goal=1.5", "gool=2"], "unexpected keyword argument 'gool'; it takes (goal: float"),
        (["--env-kwargs", "goal"], "--env-kwargs='goal': write NAME=VALUE"),
        (["--env-kwargs", "goal=1.5", "--env_kwargs", "size=4"], "is there twice; give all of NAME=VALUE after one"),
    ],
)
def test_keywords_that_do_not_fit_are_one_line(command: str, words: list[str], says: str, capsys: Any) -> None:
    assert says in complaint([command, WANTS, *words], capsys)


def test_a_run_goes_on_with_its_own_keywords_only(tmp_path: Path) -> None:
    run = wanting_run(tmp_path / "run")
    was = run.config()
    other = dataclasses.replace(was, env=dataclasses.replace(was.env, env_kwargs={"goal": 2.5, "size": 4}))
    with pytest.raises(ConfigError, match=r"--env-kwargs=\{'goal': 2.5, 'size': 4\}: the run in .* has \{'goal': 1.5"):
        open_run(other, LaunchOptions(run.path))


def test_an_environment_that_has_gained_an_observation_is_named_by_every_command(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path / "run", AGENTS["robust"], SLIDE)
    older = make_run(tmp_path / "older", AGENTS["robust"], SLIDE, header=False)
    monkeypatch.setattr(habits.Slide, "observation_space", Box(-99.0, 99.0, (4,), np.float32))
    monkeypatch.setattr(habits.Slide, "seen", lambda self: np.zeros(4, np.float32))
    says = f"ENV='{SLIDE}': the environment now has 4 observations, the run was trained with 3; undo that"
    before = sorted(path.name for path in run.path.iterdir())
    out = str(tmp_path / "out.")
    for words in (["evaluate", str(run.path)], ["export", str(older.path), "--out", f"{out}onnx"]):
        assert says in complaint(words, capsys)
    assert says in complaint(["inspect", str(run.path), "--out", f"{out}png"], capsys)
    for resume in (
        lambda: open_run(run.config(), LaunchOptions(run.path)),
        load_policy(run.path).make_env,
        lambda: load_policy(older.path),
    ):
        with pytest.raises(ConfigError, match="the environment now has 4 observations, the run was trained with 3"):
            resume()
    assert sorted(path.name for path in run.path.iterdir()) == before


def test_an_environment_whose_actions_have_other_bounds_is_named(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, kept = (make_run(tmp_path / name, AGENTS["robust"], SLIDE) for name in ("run", "kept"))
    (kept.path / "replay").mkdir()
    kept.write_sizes({"observations": 3, "actions": 2, "flags of what is missing": 1})  # as an older version
    monkeypatch.setattr(habits.Slide, "action_space", Box(-1.0, np.float32([1, 5]), (2,), np.float32))
    says = f"ENV='{SLIDE}': the environment now has the highest actions [1.0, 5.0], the run was trained with [1.0, 1.0]"
    for words in (["resume"], ["evaluate"], ["inspect", "--out", str(tmp_path / "a.png")]):
        assert f"{says}; undo that, or train another run" in complaint([*words, str(run.path)], capsys)
    with pytest.raises(ConfigError, match="now has the highest actions"):
        load_policy(kept.path).make_env()
    untrained(kept.path, kept.config())
    monkeypatch.undo()
    with pytest.raises(ConfigError, match=r"the highest actions \[1.0, 1.0\], the run was trained with \[1.0, 5.0\]"):
        open_run(kept.config(), LaunchOptions(kept.path))


def test_a_run_keeps_its_number_of_flags(tmp_path: Path) -> None:
    config = debug(EnvConfig("Pendulum-v1", drop_sensors=0.2))
    run = untrained(tmp_path / "run", config)
    run.write_sizes({"observations": 3, "flags of what is missing": 1})  # and nothing of actions, as an older version
    with pytest.raises(ConfigError, match="now has 3 flags of what is missing, the run was trained with 1"):
        open_run(config, LaunchOptions(run.path))


def test_a_run_of_whole_episodes_keeps_their_length(tmp_path: Path) -> None:
    config = debug(EnvConfig("InvertedPendulum-v5"))
    config = dataclasses.replace(config, actor=dataclasses.replace(config.actor, state_strategy="episode"))
    run = untrained(tmp_path / "run", config)
    run.write_sizes(config.sizes() | {"steps an episode": 500})
    with pytest.raises(ConfigError, match="now has 1000 steps an episode, the run was trained with 500"):
        open_run(config, LaunchOptions(run.path))


@pytest.mark.parametrize(
    ("env", "says"),
    [
        ("Stumbles", "the environment's step raises LinAlgError: Singular matrix (habits.py, line "),
        ("Untyped", "the environment's reward is 'much'; return a number"),
    ],
)
def test_check_env_train_and_evaluate_say_the_same(
    env: str, says: str, tmp_path: Path, capsys: Any, caplog: Any
) -> None:
    run = make_run(tmp_path / "run", AGENTS["robust"], f"tests.habits:{env}-v0")
    for words in (
        ["check-env", run.config().env.id],
        ["evaluate", str(run.path), "--episodes", "3"],
        ["train", run.config().env.id, "--preset", "debug", "--run-dir", str(tmp_path / "new")],
    ):
        caplog.clear()
        assert main.run(words) == 1
        captured = capsys.readouterr()
        assert says in (captured.err if words[0] != "check-env" else captured.out)
        assert len(captured.err.splitlines()) <= 1
        more = f"; rmc check-env {run.config().env.id} says more\n"
        assert captured.err.endswith(more) or words[0] == "check-env"
        assert len(caplog.records) <= 1


@pytest.mark.parametrize(
    ("module", "own", "other"),
    [
        ("code", "code.py", "code is .*/code.py, which"),
        ("json", "json/__init__.py", "json is .*/json/__init__.py, which"),
        ("json.mine", "json/mine.py", "json is .*/json/__init__.py, which"),
        ("time", "time.py", "time is a part of Python, which"),
    ],
)
def test_a_module_that_has_the_name_of_one_of_pythons_is_to_be_renamed(
    module: str, own: str, other: str, tmp_path: Path
) -> None:
    (tmp_path / own).parent.mkdir(exist_ok=True)
    (tmp_path / own).write_text("import gymnasium\ngymnasium.register('Mine-v0', entry_point=object)")
    words = [
        sys.executable,
        "-P",
        "-m",
        "rmc.cli.main",
        "check-env",
        f"{module}:Mine-v0",
    ]  # -P as the command itself has
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    line = f"rmc: ENV='{module}:Mine-v0': {other} is found before yours; give {own} another name\n"
    assert re.fullmatch(line, done.stderr), done.stderr
