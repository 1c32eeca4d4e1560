"""What is missing by number, and what critics alone read: as an environment gives it, judged, or taken from it."""

from typing import Any

import numpy as np
import pytest

from rmc.common.env.config import EnvConfig
from rmc.common.env.make import env_layout, make_env
from rmc.common.errors import ConfigError, EnvFault
from tests import habits, partial_env

CHEETAH = "HalfCheetah-v5"


def partial(**options: Any) -> EnvConfig:
    return EnvConfig("tests.partial_env:Partial-v0", env_kwargs=options)


def infos_of(config: EnvConfig, privileged: bool, steps: int = 20) -> list[tuple[np.ndarray, dict[str, Any]]]:
    """Observations and infos of an episode's start."""
    env = make_env(config, privileged=privileged)
    seen = [env.reset(seed=1)]
    for _ in range(steps):
        observation, *_, info = env.step(np.full(env.action_space.shape or (), 0.5, np.float32))
        seen.append((observation, info))
    env.close()
    return seen


@pytest.mark.parametrize(("missing", "flags"), [("number", 3), ("frame", 1), ("", 1)])
def test_the_layout_is_that_of_the_first_reset(missing: str, flags: int) -> None:
    assert (env_layout(partial(missing=missing)).missing, env_layout(partial(missing=missing)).privileged) == (flags, 0)
    assert env_layout(partial(missing=missing), privileged=True).privileged == partial_env.HIDDEN_DIM


def test_what_is_missing_comes_by_number() -> None:
    seen = infos_of(partial(), privileged=False)
    flags = np.stack([info["missing"] for _, info in seen])
    assert flags.dtype == np.bool_
    assert 0.1 < flags.mean() < 0.5
    assert not np.stack([observation for observation, _ in seen])[flags].any()


def test_an_environments_own_privileged_numbers_are_float32_and_a_copy() -> None:
    seen = infos_of(partial(), privileged=True)
    assert {(info["privileged"].dtype.name, info["privileged"].shape) for _, info in seen} == {("float32", (2,))}
    (place, speed), observation = seen[-1][1]["privileged"], seen[-1][0]
    missing = seen[-1][1]["missing"]
    assert missing[0] or place == observation[0]
    assert missing[1] or speed == pytest.approx(10.0 * observation[1])


@pytest.mark.parametrize(
    "taken", [{"flicker": 0.5}, {"drop_sensors": 0.3}, {"delay": 3}, {"noise": 1.0}, {"hide": "velocities"}]
)
def test_without_them_they_are_the_observation_before_anything_is_taken(taken: dict[str, Any]) -> None:
    clear = infos_of(EnvConfig(CHEETAH), privileged=False)
    seen = infos_of(EnvConfig(CHEETAH, **taken, frame_stack=2), privileged=True)
    for (truth, _), (observation, info) in zip(clear, seen, strict=True):
        np.testing.assert_array_equal(info["privileged"], truth)
        assert observation.shape != truth.shape
    assert env_layout(EnvConfig(CHEETAH, **taken), privileged=True).privileged == 17


def test_its_own_go_before_the_observation() -> None:
    config = EnvConfig("tests.partial_env:Partial-v0", flicker=0.5, noise=0.5)
    assert env_layout(config, privileged=True).privileged == partial_env.HIDDEN_DIM


def test_where_there_is_nothing_the_option_is_refused_in_one_line() -> None:
    with pytest.raises(ConfigError, match=r"--privileged-critic=True: HalfCheetah-v5 gives no info..privileged"):
        env_layout(EnvConfig(CHEETAH), privileged=True)
    assert env_layout(EnvConfig(CHEETAH)).privileged == 0


def test_without_the_option_what_it_gives_under_that_name_is_its_own() -> None:
    config = EnvConfig("tests.habits:Gives-v0", env_kwargs={"part": 4, "value": {"privileged": "mine"}})
    assert infos_of(config, privileged=False, steps=3)[-1][1] == {"privileged": "mine"}


@pytest.mark.parametrize(
    ("first", "later", "says"),
    [
        ([1.0], None, "has shape None, at first (1,); return it in one shape, at each reset and step"),
        ([1.0], [1.0, 2.0], "has shape (2,), at first (1,); return it in one shape, at each reset and step"),
        ([1.0], [np.nan], "is not finite at [0]; return finite numbers that float32 holds"),
        ([1.0], "high", "is 'high'; return an array of numbers"),
    ],
)
def test_privileged_numbers_are_judged(first: Any, later: Any, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    infos = iter([{} if value is None else {"privileged": value} for value in (first, first, later)])
    slide = habits.Slide
    reset, step = slide.reset, slide.step
    monkeypatch.setattr(slide, "reset", lambda self, **given: (reset(self, **given)[0], next(infos)))
    monkeypatch.setattr(slide, "step", lambda self, action: (*step(self, action)[:4], next(infos)))
    env = make_env(EnvConfig("tests.habits:Slide-v0"), privileged=True)
    env.reset(seed=0)
    env.step(np.zeros(2, np.float32))
    with pytest.raises(EnvFault) as caught:
        env.step(np.zeros(2, np.float32))
    assert str(caught.value) == f'the environment\'s info["privileged"] {says}'


def test_the_flags_of_what_is_hidden_are_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(partial_env.Partial, "observation_structure", {"qpos": 1, "qvel": 2}, raising=False)
    config = EnvConfig("tests.partial_env:Partial-v0", hide="velocities")
    assert env_layout(config).missing == 1
    assert [info["missing"].shape for _, info in infos_of(config, privileged=False)] == [(1,)] * 21
