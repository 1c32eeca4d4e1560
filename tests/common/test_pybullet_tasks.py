"""PyBullet's walkers by their ids. It is large, so ``make test`` may lack it: ``make test-pybullet``."""

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rmc.cli import main
from rmc.common.env.config import EnvConfig
from rmc.common.env.make import env_layout, make_env
from rmc.common.errors import ConfigError
from tests.command import rmc

INSTALLED = all(map(importlib.util.find_spec, ("pybullet", "pybullet_envs_gymnasium")))
needs_pybullet = pytest.mark.skipif(not INSTALLED, reason="pybullet is not installed: make test-pybullet")
ANT = "pybullet/AntPositions-v0"
JOINTS_AND_FEET = {"Ant": (8, 4), "HalfCheetah": (6, 6), "Hopper": (3, 1), "Walker2D": (6, 2)}


@pytest.mark.skipif(INSTALLED, reason="it is installed")
def test_who_has_it_not_is_told_how_to_get_it() -> None:
    with pytest.raises(ConfigError, match=r"ENV='pybullet/AntPositions-v0': .* pip install -e '\.\[pybullet\]' in "):
        make_env(EnvConfig(ANT))


def walked(robot: str, part: str, steps: int = 40) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
    """(steps + 1, O) what is shown, and what the simulator has at each of them."""
    env = make_env(EnvConfig(f"pybullet/{robot}{part}-v0"))
    rng, seen, real = np.random.default_rng(0), [], []
    seen.append(env.reset(seed=1)[0])
    real.append(simulated(env.unwrapped))
    for _ in range(steps):
        seen.append(env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))[0])
        real.append(simulated(env.unwrapped))
    env.close()
    return np.stack(seen), real


def simulated(env: Any) -> dict[str, np.ndarray]:
    """Read from the simulator, past the observation."""
    client, robot = env._p, env.robot
    joints = [
        client.getJointState(joint.bodies[joint.bodyIndex], joint.jointIndex)[:2] for joint in robot.ordered_joints
    ]
    limits = [(joint.lowerLimit, joint.upperLimit) for joint in robot.ordered_joints]
    (low, high), (angles, speeds) = np.array(limits).T, np.array(joints).T
    body = robot.robot_body
    turn = np.array(body.pose().rpy())
    return {
        "angles": 2 * (angles - low) / (high - low) - 1,
        "speeds": 0.1 * speeds,
        "height": np.array(body.pose().xyz()[2]),
        "roll_pitch": turn[:2],
        "yaw": turn[2],
        "velocity": np.array(body.speed()),
        "contacts": np.array(robot.feet_contact),
    }


@needs_pybullet
@pytest.mark.parametrize("robot", JOINTS_AND_FEET)
def test_positions_are_what_the_simulator_calls_so(robot: str) -> None:
    joints, feet = JOINTS_AND_FEET[robot]
    seen, real = walked(robot, "Positions")
    assert seen.shape == (41, 3 + 2 + joints + feet)
    for observation, now in zip(seen, real, strict=True):
        assert observation[0] == pytest.approx(now["height"] - real[0]["height"], abs=1e-5)
        assert np.hypot(*observation[1:3]) == pytest.approx(1.0, abs=1e-5)
        assert np.arctan2(*observation[1:3]) == pytest.approx(-now["yaw"], abs=0.02)  # the target is far ahead
        np.testing.assert_allclose(observation[3:5], now["roll_pitch"], atol=1e-5)
        np.testing.assert_allclose(observation[5 : 5 + joints], np.clip(now["angles"], -5, 5), atol=1e-4)
    for observation, before in zip(seen[1:], real[:-1], strict=True):  # the state is read before contacts are
        np.testing.assert_array_equal(observation[5 + joints :], before["contacts"])


@needs_pybullet
@pytest.mark.parametrize("robot", JOINTS_AND_FEET)
def test_velocities_are_what_the_simulator_calls_so(robot: str) -> None:
    joints, _ = JOINTS_AND_FEET[robot]
    seen, real = walked(robot, "Velocities")
    assert seen.shape == (41, 3 + joints)
    for observation, now in zip(seen, real, strict=True):
        forward, side, up = now["velocity"]
        cosine, sine = np.cos(now["yaw"]), np.sin(now["yaw"])
        ahead = np.array([cosine * forward + sine * side, cosine * side - sine * forward, up])
        np.testing.assert_allclose(observation[:3], np.clip(0.3 * ahead, -5, 5), atol=1e-4)
        np.testing.assert_allclose(observation[3:], np.clip(now["speeds"], -5, 5), atol=1e-4)
    assert np.abs(seen).max() > 0.1


@needs_pybullet
def test_the_same_seed_gives_the_same_episode() -> None:
    """In another environment, and in the same one after another episode."""
    first, second = (walked("Ant", "Positions", 20)[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)
    env, rng = make_env(EnvConfig(ANT)), np.random.default_rng(0)
    env.reset(seed=2)
    for _ in range(10):
        env.step(np.ones(8, np.float32))
    again = [env.reset(seed=1)[0]]
    again += [env.step(rng.uniform(-1, 1, 8).astype(np.float32))[0] for _ in range(20)]
    env.close()
    np.testing.assert_array_equal(first, again)
    layout = env_layout(EnvConfig(ANT))
    assert (layout.obs_dim, layout.action_dim, layout.time_limit) == (17, 8, 1000)


@needs_pybullet
def test_an_unknown_walker_is_one_line() -> None:
    with pytest.raises(ConfigError, match=r"no such environment; did you mean .*pybullet/AntPositions-v0"):
        make_env(EnvConfig("pybullet/AntPosition-v0"))


@needs_pybullet
def test_check_train_and_evaluate(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main.run(["check-env", ANT, "--steps", "100"]) == 0
    run = ["--preset", "debug", "--total-steps", "1200", "--launcher", "lockstep", "--checkpoint-steps", "1100"]
    assert main.run(["train", ANT, *run, "--run-dir", str(tmp_path / "run")]) == 0
    assert "it can be trained on" in capfd.readouterr().out
    done = rmc("evaluate", str(tmp_path / "run"), "--episodes", "1", "--json", timeout=100)
    assert json.loads(done.stdout)["env"] == ANT, done.stderr  # and nothing else
    assert "pybullet" not in done.stderr
