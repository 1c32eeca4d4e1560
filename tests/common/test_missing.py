"""Missing frames, sensors that fail one by one, and late ones, as the agent sees them."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rmc.common.env.config import EnvConfig
from rmc.common.env.make import env_layout, make_env
from rmc.common.env.missing import DropSensors, Flicker
from rmc.common.env.wrappers import Delay, ObservationSlice
from rmc.common.errors import ConfigError
from tests.common.test_wrappers import ACTION, CHEETAH, played

SIZE = 20


class Ones(gym.Env[Any, Any]):
    """Shows ones, and says of every third step that something is missing."""

    observation_space = gym.spaces.Box(-1, 1, (SIZE,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, missing: Any = None) -> None:
        self._missing, self._steps = missing, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._steps = 0
        return np.ones(SIZE, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._steps += 1
        own = {} if self._missing is None or self._steps % 3 else {"missing": self._missing}
        return np.ones(SIZE, np.float32), 0.0, False, False, own


gym.register("Ones-v0", entry_point=Ones, max_episode_steps=100)


def flags(env: Any, steps: int, seed: int = 1) -> np.ndarray:
    """(steps + 1, …) what is missing in one episode."""
    missing = [env.reset(seed=seed)[1]["missing"]]
    return np.array(missing + [env.step(ACTION[:1])[4]["missing"] for _ in range(steps)])


def test_each_sensor_fails_on_its_own_and_nothing_else_changes() -> None:
    clear, rewards, _ = played(EnvConfig(CHEETAH), 300)
    seen, same_rewards, infos = played(EnvConfig(CHEETAH, drop_sensors=0.3), 300)
    missing = np.array([info["missing"] for info in infos])
    assert (missing.shape, missing.dtype) == ((301, 17), bool)
    np.testing.assert_array_equal(seen, np.where(missing, 0.0, clear))
    np.testing.assert_array_equal(rewards, same_rewards)
    assert missing.mean() == pytest.approx(0.3, abs=5 * math.sqrt(0.21 / missing.size))
    assert np.abs(np.corrcoef(missing.T) - np.eye(17)).max() < 5 / math.sqrt(len(missing))
    again, other = (played(EnvConfig(CHEETAH, drop_sensors=0.3), 300, seed)[2] for seed in (1, 2))
    np.testing.assert_array_equal(missing, [info["missing"] for info in again])
    assert not np.array_equal(missing, [info["missing"] for info in other])


def test_a_flickering_run_is_repeated_bit_by_bit() -> None:
    """Its random numbers are those of the versions before bursts: one for each step."""
    expected = np.random.default_rng([7, 0xF11C]).random(301) < 0.4
    np.testing.assert_array_equal(flags(Flicker(Ones(), 0.4), 300, seed=7), expected)


@pytest.mark.parametrize("kind", [Flicker, DropSensors])
@pytest.mark.parametrize(("share", "burst"), [(0.3, 1.0), (0.5, 5.0), (0.7, 2.0), (0.1, 10.0)])
def test_bursts_have_their_length_and_leave_the_share(kind: Any, share: float, burst: float) -> None:
    steps = 20_000 if kind is DropSensors else 60_000
    missing = flags(kind(Ones(), share, burst), steps).reshape(steps + 1, -1).T
    length = max(burst, 1 / (1 - share))  # chance alone makes the second
    starts = np.diff(missing.astype(int), prepend=0, axis=1) == 1
    bursts = missing.sum(1).sum() / starts.sum()
    deviation = math.sqrt(share * (1 - share) * 2 * length / missing.size)
    assert missing.mean() == pytest.approx(share, abs=5 * deviation)
    assert bursts == pytest.approx(length, abs=5 * length / math.sqrt(starts.sum()))
    stays = missing[:, 1:][missing[:, :-1]]  # geometric: as likely to stay after one step as after many
    after_many = missing[:, 3:][missing[:, :-3] & missing[:, 1:-2] & missing[:, 2:-1]]
    assert stays.mean() == pytest.approx(1 - 1 / length, abs=5 * math.sqrt(0.25 / len(stays)))
    assert after_many.mean() == pytest.approx(1 - 1 / length, abs=5 * math.sqrt(0.25 / len(after_many)))


def test_bursts_shorter_than_chance_makes_them_are_chance() -> None:
    plain, short = (flags(DropSensors(Ones(), 0.7, burst), 100) for burst in (1.0, 3.0))
    np.testing.assert_array_equal(plain, short)


def test_an_episode_begins_with_the_long_run_share() -> None:
    env = DropSensors(Ones(), 0.3, 10.0)
    env.reset(seed=3)
    first = np.array([env.reset()[1]["missing"] for _ in range(1000)])
    assert first.mean() == pytest.approx(0.3, abs=5 * math.sqrt(0.21 / first.size))


@pytest.mark.parametrize("burst", [1.0, 5.0])
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_none_or_all_may_be_missing(share: float, burst: float) -> None:
    assert (flags(DropSensors(Ones(), share, burst), 50) == bool(share)).all()
    assert (flags(Flicker(Ones(), share, burst), 50) == bool(share)).all()


def test_a_missing_frame_lacks_every_sensor() -> None:
    seen, _, infos = played(EnvConfig(CHEETAH, flicker=0.4, drop_sensors=0.3), 200)
    missing = np.array([info["missing"] for info in infos])
    np.testing.assert_array_equal(seen == 0.0, missing)
    whole = [info["missing"] for info in played(EnvConfig(CHEETAH, flicker=0.4), 200)[2]]
    own = np.array([info["missing"] for info in played(EnvConfig(CHEETAH, drop_sensors=0.3), 200)[2]])
    np.testing.assert_array_equal(missing, own | np.array(whole)[:, None])  # each with its own random numbers


def test_what_the_environment_lacks_itself_stays_missing() -> None:
    whole, one = True, np.arange(SIZE) == 4
    flicker, drops = (flags(kind(Ones(whole), 0.3), 60) for kind in (Flicker, DropSensors))
    assert flicker[3::3].all()
    assert drops[3::3].all()
    assert not drops[1::3].all(1).any()
    drops = flags(DropSensors(Ones(one), 0.3), 60)
    assert drops[3::3, 4].all()
    assert 0 < drops[3::3, 5].mean() < 1
    env = Flicker(Ones(one), 0.5)
    env.reset(seed=1)
    third = [env.step(ACTION[:1])[4]["missing"] for _ in range(60)][2::3]
    assert {tuple(row.tolist()) for row in third} == {tuple(one.tolist()), (True,) * SIZE}


def test_of_the_dimensions_that_are_hidden_nothing_is_said() -> None:
    env = ObservationSlice(Ones(np.arange(SIZE) % 2 == 0), slice(3, 7))
    env.reset(seed=1)
    infos = [env.step(ACTION[:1])[4] for _ in range(3)]
    assert infos[:2] == [{}, {}]
    assert infos[2]["missing"].tolist() == [False, True, False, True]
    seen, _, infos = played(EnvConfig(CHEETAH, hide="velocities", drop_sensors=0.5))
    assert all(info["missing"].shape == (8,) for info in infos)
    assert env_layout(EnvConfig(CHEETAH, hide="velocities", drop_sensors=0.5)).obs_dim == 8
    np.testing.assert_array_equal(seen == 0.0, [info["missing"] for info in infos])


@pytest.mark.parametrize("delay", [1, 4])
def test_a_late_observation_is_that_of_so_many_steps_ago(delay: int) -> None:
    clear, rewards, _ = played(EnvConfig(CHEETAH))
    late, same_rewards, infos = played(EnvConfig(CHEETAH, delay=delay))
    for t, observation in enumerate(late):
        np.testing.assert_array_equal(observation, clear[max(0, t - delay)])
    np.testing.assert_array_equal(rewards, same_rewards)
    assert not any(info["missing"] for info in infos)
    env = make_env(EnvConfig(CHEETAH, delay=delay))
    first, _ = env.reset(seed=5)
    env.step(ACTION)
    assert not np.array_equal(env.reset(seed=6)[0], first)  # nothing of the episode before


def test_an_environments_missing_frame_is_late_with_its_observation() -> None:
    missing = flags(Delay(Ones(True), 2), 12)
    assert np.flatnonzero(missing).tolist() == [5, 8, 11]  # 3, 6 and 9, two steps later


def test_a_delay_counts_the_agents_steps() -> None:
    late, _, _ = played(EnvConfig(CHEETAH, action_repeat=3, delay=2), 8)
    repeated, _, _ = played(EnvConfig(CHEETAH, action_repeat=3), 8)
    np.testing.assert_array_equal(late[2:], repeated[:-2])


def test_each_step_of_the_agent_draws_once() -> None:
    plain, repeated = (
        [info["missing"] for info in played(EnvConfig(CHEETAH, drop_sensors=0.5, action_repeat=repeat), 8)[2]]
        for repeat in (1, 3)
    )
    np.testing.assert_array_equal(plain, repeated)


def test_the_order_is_noise_delay_sensors_frames_stack() -> None:
    """What is late has the noise of its own time; what is missing is drawn anew, at the step that lacks it."""
    options: dict[str, Any] = {"drop_sensors": 0.3, "flicker": 0.2, "flicker_burst": 3.0}
    noisy, _, _ = played(EnvConfig(CHEETAH, noise=0.5))
    missing = np.array([info["missing"] for info in played(EnvConfig(CHEETAH, **options))[2]])
    late = noisy[np.maximum(0, np.arange(31) - 2)]
    seen, _, infos = played(EnvConfig(CHEETAH, noise=0.5, delay=2, **options))
    np.testing.assert_array_equal(seen, np.where(missing, 0.0, late))
    np.testing.assert_array_equal([info["missing"] for info in infos], missing)
    stacked, _, infos = played(EnvConfig(CHEETAH, noise=0.5, delay=2, frame_stack=2, **options))
    np.testing.assert_array_equal(stacked[1:], np.hstack([seen[:-1], seen[1:]]))
    assert all(info["missing"] is False for info in infos)


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (EnvConfig(CHEETAH, drop_sensors=1.5), "--drop-sensors=1.5: take a number from 0 to 1"),
        (EnvConfig(CHEETAH, drop_sensors=math.nan), "--drop-sensors=nan: take a number from 0 to 1"),
        (EnvConfig(CHEETAH, flicker_burst=0.5), "--flicker-burst=0.5: take a number from 1 to 1_000_000"),
        (EnvConfig(CHEETAH, flicker_burst=math.inf), "--flicker-burst=inf: take a number from 1 to 1_000_000"),
        (EnvConfig(CHEETAH, delay=-1), "--delay=-1: take a number from 0 to 1_000_000"),
        (EnvConfig(CHEETAH, delay=1000), "--delay=1000: an episode ends after 1000 steps; take fewer"),
        (EnvConfig(CHEETAH, delay=7, time_limit=20, action_repeat=3), "--delay=7: an episode ends after 7 steps"),
    ],
    ids=lambda value: "" if isinstance(value, EnvConfig) else value.partition(":")[0],
)
def test_a_bad_value_is_one_line(config: EnvConfig, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make_env(config)
    assert str(caught.value).startswith(says)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", [Flicker, DropSensors])
def test_what_is_missing_of_an_episode_follows_from_its_seed_alone(kind: Any) -> None:
    """Not from whether the episode before ended amid a burst."""
    env = kind(Ones(), 0.5, 20.0)
    expected = flags(env, 30, seed=7)
    for before in range(2, 12):
        flags(env, before, seed=before)
        np.testing.assert_array_equal(flags(env, 30, seed=7), expected)
