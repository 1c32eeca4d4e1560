"""dm_control's tasks by their gymnasium ids. It needs MuJoCo 3, so ``make test`` lacks it: ``make test-dm-control``."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from rmc.cli import main
from rmc.common.env.config import EnvConfig
from rmc.common.env.make import env_layout, make_env
from rmc.common.errors import ConfigError

INSTALLED = importlib.util.find_spec("dm_control") is not None
needs_dm_control = pytest.mark.skipif(not INSTALLED, reason="dm_control is not installed: make test-dm-control")
WALKER = "dm_control/walker-walk-v0"


@pytest.mark.skipif(INSTALLED, reason="it is installed")
def test_who_has_it_not_is_told_how_to_get_it() -> None:
    with pytest.raises(ConfigError, match=r"ENV='dm_control/walker-walk-v0': .* pip install -e '\.\[dm-control\]' in "):
        make_env(EnvConfig(WALKER))


@pytest.mark.skipif(INSTALLED, reason="it is installed")
def test_what_its_import_raises_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where MUJOCO_GL names no renderer."""
    for name in ("shimmy", "dm_control"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('invalid value for environment variable MUJOCO_GL')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=r"^ENV='dm_control/walker-walk-v0': shimmy cannot be imported: Runtime.*_GL"):
        make_env(EnvConfig(WALKER))


@needs_dm_control
@pytest.mark.parametrize("env_id", [WALKER, f"shimmy:{WALKER}"])
def test_a_task_is_an_environment_like_others(env_id: str) -> None:
    layout = env_layout(EnvConfig(env_id))
    assert (layout.obs_dim, layout.action_dim, layout.time_limit) == (24, 6, None)
    env = make_env(EnvConfig(env_id, flicker=0.5))
    observation, _ = env.reset(seed=1)
    assert observation.shape == (24,)
    assert observation.dtype == np.float32
    steps, truncated = 0, False
    while not truncated:
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        steps += 1
        assert np.isfinite(observation).all()
        assert np.isfinite(reward)
        assert not terminated
        assert info["missing"] == (not observation.any())
    assert steps == 1000
    env.close()


@needs_dm_control
def test_an_unknown_task_is_one_line() -> None:
    with pytest.raises(ConfigError, match=r"no such environment; did you mean .*dm_control/walker-walk-v0"):
        make_env(EnvConfig("dm_control/walker-wlak-v0"))


@needs_dm_control
def test_check_train_and_evaluate(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main.run(["check-env", WALKER]) == 0
    run = ["--preset", "debug", "--total-steps", "1200", "--launcher", "lockstep", "--checkpoint-steps", "1100"]
    assert main.run(["train", WALKER, *run, "--run-dir", str(tmp_path / "run")]) == 0
    assert main.run(["evaluate", str(tmp_path / "run"), "--episodes", "1"]) == 0
    captured = capfd.readouterr()
    assert "it can be trained on" in captured.out
    assert "GLFW" not in captured.err
