"""What is done to an environment before the agent sees it."""

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rmc.common.env import wrappers
from rmc.common.env.config import EnvConfig
from rmc.common.env.layout import Part
from rmc.common.env.make import env_layout, make_env
from rmc.common.env.missing import DropSensors, Flicker
from rmc.common.env.wrappers import Delay, ObservationSlice, RescaledEnv
from rmc.common.errors import EnvFault
from tests.broken_env import BREAKS_AT, BrokenEnv

CHEETAH, ACTION = "HalfCheetah-v5", np.linspace(-1, 1, 6, dtype=np.float32)


def first_number(env: Any) -> ObservationSlice:
    return ObservationSlice(env, slice(0, 1))


def played(config: EnvConfig, steps: int = 30, seed: int = 1) -> tuple[np.ndarray, np.ndarray, list[dict[str, Any]]]:
    """Observations (steps + 1, O), rewards (steps,) and infos of one episode's start."""
    env = make_env(config)
    observation, info = env.reset(seed=seed)
    observations, rewards, infos = [observation], [], [info]
    for _ in range(steps):
        observation, reward, *_, info = env.step(ACTION)
        observations.append(observation)
        rewards.append(reward)
        infos.append(info)
    env.close()
    assert all(o.dtype == np.float32 for o in observations)
    assert observations[0].shape == env.observation_space.shape
    return np.stack(observations), np.array(rewards), infos


@pytest.mark.parametrize(("hide", "kept"), [("velocities", slice(0, 8)), ("positions", slice(8, 17))])
def test_part_of_the_observation_is_left_out(hide: Any, kept: slice) -> None:
    clear, rewards, _ = played(EnvConfig(CHEETAH))
    seen, same_rewards, _ = played(EnvConfig(CHEETAH, hide=hide))
    np.testing.assert_array_equal(seen, clear[:, kept])
    np.testing.assert_array_equal(rewards, same_rewards)
    assert env_layout(EnvConfig(CHEETAH, hide=hide)).obs_dim == seen.shape[1]


def test_what_depends_on_velocities_goes_with_them() -> None:
    assert env_layout(EnvConfig("Ant-v5", hide="velocities")).obs_dim == 13
    assert env_layout(EnvConfig("Ant-v5", hide="positions")).obs_dim == 105 - 13


def test_noise_is_gaussian_independent_and_seeded() -> None:
    clear, _, _ = played(EnvConfig(CHEETAH), 300)
    noisy, _, _ = played(EnvConfig(CHEETAH, noise=0.5), 300)
    noise = (noisy - clear) / 0.5
    assert abs(noise.mean()) < 5 / np.sqrt(noise.size)
    assert noise.std() == pytest.approx(1.0, rel=0.05)
    assert np.abs(np.corrcoef(noise.T) - np.eye(17)).max() < 5 / np.sqrt(len(noise))
    np.testing.assert_array_equal(noisy, played(EnvConfig(CHEETAH, noise=0.5), 300)[0])
    assert not np.array_equal(noisy, played(EnvConfig(CHEETAH, noise=0.5), 300, seed=2)[0])


def test_a_missing_frame_has_no_noise() -> None:
    seen, _, infos = played(EnvConfig(CHEETAH, noise=0.5, flicker=0.5))
    for observation, info in zip(seen, infos, strict=True):
        assert observation.any() == (not info["missing"])


def test_what_the_environment_calls_missing_has_no_noise() -> None:
    seen, _, infos = played(EnvConfig("tests.partial_env:Partial-v0", noise=0.5))
    flags = np.array([info["missing"] for info in infos])
    assert 0.1 < flags.mean() < 0.5
    np.testing.assert_array_equal(np.stack(seen) != 0.0, ~flags)


@pytest.mark.parametrize(
    "wrap",
    [partial(Delay, steps=20), partial(Flicker, probability=1.0), partial(DropSensors, probability=1.0), first_number],
    ids=["delay", "flicker", "drop", "hide"],
)
def test_what_is_not_finite_is_a_fault_at_once_whatever_hides_it(wrap: Callable[[Any], Any]) -> None:
    env = wrap(RescaledEnv(BrokenEnv("nan")))
    for seed in (1, None, None):  # it breaks in the third, which is long enough
        env.reset(seed=seed)
    action = np.zeros(env.action_space.shape, np.float32)
    for _ in range(1, BREAKS_AT):
        env.step(action)
    with pytest.raises(EnvFault, match="the environment's observation is not finite"):
        env.step(action)


def test_stacked_frames_are_the_newest_oldest_first() -> None:
    clear, _, _ = played(EnvConfig(CHEETAH))
    stacked, _, infos = played(EnvConfig(CHEETAH, frame_stack=3))
    for t, observation in enumerate(stacked):
        wanted = np.concatenate([clear[max(0, t - 2)], clear[max(0, t - 1)], clear[t]])
        np.testing.assert_array_equal(observation, wanted)
    assert not any(info["missing"] for info in infos)


def test_a_stack_holds_missing_frames_as_they_are() -> None:
    missing = [info["missing"] for info in played(EnvConfig(CHEETAH, flicker=0.5))[2]]
    stacked, _, infos = played(EnvConfig(CHEETAH, flicker=0.5, frame_stack=2))
    for t in range(1, len(stacked)):
        older, newest = stacked[t, :17], stacked[t, 17:]
        assert (not older.any(), not newest.any()) == (missing[t - 1], missing[t])
        assert infos[t]["missing"] is False


def test_repeated_actions_add_their_rewards() -> None:
    clear, rewards, _ = played(EnvConfig(CHEETAH), 30)
    repeated, sums, _ = played(EnvConfig(CHEETAH, action_repeat=3), 10)
    np.testing.assert_allclose(repeated, clear[::3], rtol=1e-6)
    np.testing.assert_allclose(sums, rewards.reshape(10, 3).sum(1))


@pytest.mark.parametrize(("repeat", "limit", "steps"), [(1, 7, 7), (3, 7, 3), (3, 0, 334)])
def test_a_time_limit_counts_the_environments_steps(repeat: int, limit: int, steps: int) -> None:
    config = EnvConfig(CHEETAH, action_repeat=repeat, time_limit=limit)
    assert env_layout(config).time_limit == steps
    env = make_env(config)
    env.reset(seed=0)
    assert [env.step(ACTION)[2:4] for _ in range(steps)] == [(False, False)] * (steps - 1) + [(False, True)]
    env.close()


class Reused(gym.Env[Any, Any]):
    """Counts, in the one array that it ever gives."""

    observation_space, action_space = gym.spaces.Box(-9, 9, (1,)), gym.spaces.Box(-1, 1, (1,))

    def __init__(self) -> None:
        self._seen = np.zeros(1, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._seen[:] = 0
        return self._seen, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._seen += 1
        return self._seen, 0.0, False, False, {}


gym.register("Reused-v0", entry_point=Reused)


def test_an_environment_may_write_into_the_array_that_it_gave() -> None:
    env = make_env(EnvConfig("Reused-v0", frame_stack=3))
    before, _ = env.reset(seed=0)
    seen = [env.step(np.zeros(1, np.float32))[0].tolist() for _ in range(3)]
    assert (before.tolist(), seen) == ([0, 0, 0], [[0, 0, 1], [0, 1, 2], [1, 2, 3]])


class LastReading(gym.Env[Any, Any]):
    """Gives the number that it says is missing all the same."""

    observation_space, action_space = gym.spaces.Box(-99, 99, (2,)), gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return np.array([1, 2], np.float32), {"missing": np.array([False, False])}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.array([7, 8], np.float32), 0.0, False, False, {"missing": np.array([True, False])}


gym.register("LastReading-v0", entry_point=LastReading)


def test_a_stack_holds_zeros_for_what_is_missing() -> None:
    env = make_env(EnvConfig("LastReading-v0", frame_stack=2))
    env.reset(seed=0)
    observation, _, _, _, info = env.step(np.zeros(1, np.float32))
    assert (observation.tolist(), info["missing"]) == ([1, 2, 0, 8], False)


class Parts(gym.Env[Any, Any]):
    """A Dict of boxes."""

    observation_space = gym.spaces.Dict(b=gym.spaces.Box(-9, 9, (2, 2)), a=gym.spaces.Box(-9, 9, (1,), np.float64))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return {"b": np.array([[1, 2], [3, 4]], np.float32), "a": np.array([5.0])}, {}


gym.register("Parts-v0", entry_point=Parts)


def test_a_dict_of_boxes_is_flattened() -> None:
    config = EnvConfig("Parts-v0")
    layout = env_layout(config)
    assert (layout.obs_dim, layout.action_dim, layout.time_limit) == (5, 1, None)
    assert layout.observations == (Part("b", 0, 4, (2, 2), "float32"), Part("a", 4, 5, (1,), "float64"))
    assert layout.actions == (Part("", 0, 1, (1,), "float32"),)
    observation, _ = make_env(config).reset(seed=0)
    assert observation.tolist() == [1, 2, 3, 4, 5]


def test_the_layout_names_what_is_shown_of_a_mujoco_body() -> None:
    """Every part by its name: as many numbers as the observation has, whatever is hidden or stacked."""
    shown = {
        hide: env_layout(EnvConfig("Humanoid-v5", hide=hide))  # type: ignore[arg-type]
        for hide in ("nothing", "velocities", "positions")
    }
    names = ["qpos", "qvel", "cinert", "cvel", "qfrc_actuator", "cfrc_ext"]
    assert [part.name for part in shown["nothing"].observations] == names
    assert shown["velocities"].observations == (Part("qpos", 0, 22, (22,), "float64"),)
    assert [part.name for part in shown["positions"].observations] == names[1:]
    assert [shown[hide].obs_dim for hide in shown] == [348, 22, 326]
    stacked = env_layout(EnvConfig(CHEETAH, frame_stack=3))
    assert (stacked.frames, stacked.obs_dim, stacked.observations[-1].stop) == (3, 51, 17)
    assert (stacked.action_low, stacked.action_high) == ((-1.0,) * 6, (1.0,) * 6)


class OldName(gym.Env[np.ndarray, np.ndarray]):
    """Says that a frame is missing as environments of version 0.1 did."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, **_: Any) -> tuple[np.ndarray, dict[str, Any]]:
        return np.zeros(2, np.float32), {"blank": True}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return np.zeros(2, np.float32), 0.0, False, False, {"blank": False, "goal": 3}


def test_the_old_name_of_a_missing_frame_is_understood_with_one_warning(caplog: pytest.LogCaptureFixture) -> None:
    wrappers._warn_once.cache_clear()
    env = RescaledEnv(OldName())
    assert env.reset()[1] == {"missing": True}
    assert [env.step(ACTION[:1])[4] for _ in range(3)] == [{"missing": False, "goal": 3}] * 3
    assert [record.message for record in caplog.records if "info" in record.message] == [
        'the environment gives info["blank"]; call it info["missing"], the old name goes in the next version'
    ]


def test_a_stack_begins_anew_with_every_episode() -> None:
    env = make_env(EnvConfig("Reused-v0", frame_stack=3))
    for _ in range(2):
        assert env.reset(seed=0)[0].tolist() == [0, 0, 0]
        assert env.step(np.zeros(1, np.float32))[0].tolist() == [0, 0, 1]


@pytest.mark.parametrize("ends", [(False, False), (True, False), (False, True), (True, True)])
def test_how_an_episode_ends_is_passed_on(ends: tuple[bool, bool]) -> None:
    """A time limit of the environment's own is no termination."""

    class Ends(Reused):
        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            return self._seen, 0.0, *ends, {}

    env = RescaledEnv(Ends())
    env.reset(seed=0)
    assert env.step(np.zeros(1, np.float32))[2:4] == ends
