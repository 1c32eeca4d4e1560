"""rmc check-env, as someone who brings an environment sees it."""

import asyncio
import re
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rmc.cli import main
from rmc.common.env.config import EnvConfig
from rmc.deploy.run.presets import debug
from rmc.deploy.run.validation import validate


def checked(env: str, capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, str]:
    status = main.run(["check-env", env, *options])
    return status, capsys.readouterr().out


class Odd(gym.Env[Any, Any]):
    """Sound but strange: large rewards, a dimension that never moves, no end, another start each time."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self._observation(), 1000.0, False, False, {}

    def _observation(self) -> Any:
        return np.array([np.random.default_rng().normal(), 0.0, 1e6 * np.random.default_rng().normal()], np.float32)


class Unrewarded(Odd):
    """Never rewards."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self._observation(), 0.0, False, False, {}


class Untold(Odd):
    """What critics alone may read is no number."""

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        return super().reset(**options)[0], {"privileged": [1.0, np.nan]}


class Late(Odd):
    """Gives what critics alone may read from its first step on, but at no reset."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return *super().step(action)[:4], {"privileged": [1.0, 2.0]}


class Faint(Odd):
    """Its numbers are in metres, and move by tens of micrometres."""

    def _observation(self) -> Any:
        return (1e-5 * np.random.default_rng().normal(size=3)).astype(np.float32)


class Still(Odd):
    """Its numbers never change, and are none that a binary fraction holds."""

    def _observation(self) -> Any:
        return np.array([0.1, 0.3, 9.81], np.float32)


class Normed(Odd):
    """Divides by its action's size."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        with np.errstate(invalid="ignore"):
            return np.full(3, action[0] / abs(action[0]), np.float32), 1.0, False, False, {}


class Spent(Odd):
    """Has levels for small seeds alone."""

    def reset(self, *, seed: int | None = None, **options: Any) -> tuple[Any, dict[str, Any]]:
        if seed is not None and seed >= 2**16:
            raise RuntimeError("no level has this seed")
        return super().reset(seed=seed, **options)


class Drawn(Odd):
    """Each has other sizes than the one before."""

    made = 0

    def __init__(self, what: str) -> None:
        Drawn.made += 1
        if what == "bounds":
            self.action_space = gym.spaces.Box(-1.0, float(Drawn.made), (1,), np.float32)
        else:
            self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2 + Drawn.made,), np.float32)

    def _observation(self) -> Any:
        return np.resize(super()._observation(), self.observation_space.shape)


class Short(gym.Env[Any, Any]):
    """Sound, but gives one array again and again, ends at once, or says so in a number: gymnasium reads more in it."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, reused: bool, length: int, kind: Any) -> None:
        self._seen, self._reused, self._length, self._kind = np.zeros(1), reused, length, kind

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, Any, dict[str, Any]]:
        self._steps += 1
        return self._observation(), 1.0, False, self._kind(self._steps >= self._length), {}

    def _observation(self) -> Any:
        self._seen[:] = self.np_random.normal()
        return self._seen if self._reused else self._seen.copy()


class Vaster(Odd):
    """Its numbers are nearly the largest that float32 holds."""

    def _observation(self) -> Any:
        return (3e38 * np.random.default_rng().uniform(-1.0, 1.0, 3)).astype(np.float32)


class Panics(Odd):
    """A Rust library's panic is no Exception, and is not caught as one."""

    def step(self, action: Any) -> Any:
        raise asyncio.CancelledError("panic")


class Outside(Odd):
    """Its numbers leave its space."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)


def mended(**kwargs: Any) -> gym.Env[Any, Any]:
    """What gymnasium would complain of, but for a wrapper of the user's."""
    space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
    return gym.wrappers.TransformObservation(Outside(**kwargs), lambda o: (o * 0.0 + 0.5).astype(np.float32), space)


class Rewarded(Odd):
    """Each reward has the same size, but for every hundredth."""

    def __init__(self, size: float, rare: float = 0.0) -> None:
        self._size, self._rare, self._steps = size, rare, 0

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._steps += 1
        return self._observation(), self._rare if self._steps % 100 == 0 else self._size, False, False, {}


for _name, _sizes in {
    "Huge": (-1e30,), "Vast": (1e39,), "Tiny": (1e-9,), "Rare": (0.0, 1e6), "Plain": (1.0, 90.0),
}.items():  # fmt: skip
    gym.register(f"{_name}-v0", Rewarded, kwargs=dict(zip(("size", "rare"), _sizes, strict=False)))
gym.register("Odd-v0", entry_point=Odd)
gym.register("Faint-v0", entry_point=Faint)
gym.register("Constant-v0", entry_point=Still)
gym.register("Outside-v0", entry_point=Outside)
gym.register("Mended-v0", entry_point=mended)
gym.register("Untold-v0", entry_point=Untold)
gym.register("Spent-v0", entry_point=Spent)
for _what in ("bounds", "observations"):
    gym.register(f"Drawn-{_what}-v0", entry_point=Drawn, kwargs={"what": _what})
for _name, _habits in {"Rewritten": (True, 9, bool), "Once": (False, 1, bool), "Counted": (False, 9, np.int64)}.items():
    gym.register(f"{_name}-v0", Short, kwargs=dict(zip(("reused", "length", "kind"), _habits, strict=True)))
gym.register("Vaster-v0", entry_point=Vaster)
gym.register("Panics-v0", entry_point=Panics)
gym.register("Late-v0", entry_point=Late)
gym.register("Normed-v0", entry_point=Normed)
gym.register("Unrewarded-v0", entry_point=Unrewarded)


def test_a_sound_environment(capsys):
    status, text = checked("HalfCheetah-v5", capsys)
    assert status == 0
    assert "observations 17, actions 6, time limit 1000" in text
    assert re.search(r"2,000 random steps, [\d,]+ a second; reward -?[\d.]+ ± [\d.]+", text)
    assert "2 episodes of 1000 steps, 0 of them terminated" in text
    assert "cannot learn of anything older than 15 steps; episodes last up to 1,000 (--trained-steps, or " in text
    assert text.endswith("it can be trained on\n")
    assert "note" not in text


def test_what_is_strange_is_noted_with_the_option_that_helps(capsys):
    status, text = checked("Odd-v0", capsys, "--steps", "300")
    assert status == 0
    for words in (
        "observations 1 never changed", "observations reach", "--reward-scale 0.001", "--time-limit",
        "episodes have no known time limit (--trained-steps, or --time-limit and --state-strategy episode)",
    ):  # fmt: skip
        assert words in text
    assert "the same seed and actions gave other observations" in text
    assert "--curiosity" in checked("Unrewarded-v0", capsys, "--steps", "100")[1]
    assert "observations 0, 1, 2 vary by less than 0.01; scale them up" in checked("Faint-v0", capsys)[1]
    assert "observations 0, 1, 2 vary by less than 0.01" in checked("Faint-v0", capsys, "--drop-sensors", "0.5")[1]
    assert "vary by less" not in checked("Faint-v0", capsys, "--flicker", "1")[1]  # nobody knows
    status = main.run(["check-env", "Faint-v0", "--flicker-burst", "5"])
    assert (status, "--flicker-burst=5.0: nothing is missing; give --flicker" in capsys.readouterr().err) == (2, True)
    still = checked("Constant-v0", capsys)[1]
    assert "observations 0, 1, 2 never changed" in still
    assert "scale them up" not in still


def test_it_is_judged_with_the_users_own_wrappers(capsys):
    assert "gymnasium says" in checked("Outside-v0", capsys, "--steps", "50")[1]
    assert "gymnasium says" not in checked("Mended-v0", capsys, "--steps", "50")[1]


@pytest.mark.parametrize(
    ("env", "status", "words"),
    [
        ("Huge", 0, "note: rewards are large, up to 1e+30 a step; try --reward-scale 1e-30"),
        ("Rare", 0, "note: rewards are large, up to 1e+06 a step; try --reward-scale 0.0001"),
        ("Tiny", 0, "note: rewards are small, 1e-09 a step at most; try --reward-scale 1e+09"),
        ("Vast", 1, "fault: rewards reach 1e+39, past what float32 holds"),
    ],
)
def test_a_reward_scale_is_proposed_that_train_takes(env, status, words, capsys):
    exit_code, text = checked(f"{env}-v0", capsys, "--steps", "300")
    assert exit_code == status
    assert words in text
    if status == 0:
        scale = float(text.partition("--reward-scale ")[2].split()[0])
        config = debug(EnvConfig(f"{env}-v0"))
        validate(replace(config, actor=replace(config.actor, reward_scale=scale)))


def test_rewards_of_an_ordinary_size_need_no_scale(capsys):
    assert "--reward-scale" not in checked("Plain-v0", capsys, "--steps", "300")[1]


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (
            "raise",
            "fault: the environment's step raises RuntimeError: the simulation is unstable (broken_env.py, line ",
        ),
        ("nan", "fault: the environment's observation is not finite"),
        ("reward", "fault: rewards are not finite"),
        ("shape", "fault: the environment's observation has shape (3,), its space says (4,)"),
    ],
)
def test_faults_are_named(fault, words, capsys):
    status, text = checked(f"tests.broken_env:Broken-{fault}-v0", capsys)
    assert status == 1
    assert words in text
    assert "fix the fault first" in text


def test_a_fault_at_another_seed_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    status, text = checked("Spent-v0", capsys, "--steps", "50")
    assert status == 1
    assert "fault: the environment's reset raises RuntimeError: no level has this seed" in text
    assert "gave other observations" not in text


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("bounds", "the highest actions of a second one are [2.0], of the first [1.0]"),
        ("observations", "observations of a second one are 4, of the first 3"),
    ],
)
def test_sizes_that_differ_from_one_to_the_next_are_a_fault(
    what: str, words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Drawn, "made", 0)
    status, text = checked(f"Drawn-{what}-v0", capsys, "--steps", "50")
    assert status == 1
    assert f"fault: {words}; give each the same\n" in text


@pytest.mark.parametrize("env", ["Rewritten", "Once", "Counted"])
def test_gymnasiums_notes_of_what_is_sound_are_left_out(env: str, capsys: pytest.CaptureFixture[str]) -> None:
    status, text = checked(f"{env}-v0", capsys, "--steps", "50")
    assert status == 0
    for words in ("non-deterministic", "truncates after 1 step", "gave other observations"):
        assert words not in text


def test_numbers_near_the_largest_are_noted_without_a_warning(capsys: pytest.CaptureFixture[str], recwarn: Any) -> None:
    status, text = checked("Vaster-v0", capsys, "--steps", "50")
    assert status == 0
    assert re.search(r"observations reach [23]\.?\d*e\+38; scale them", text)
    assert not [str(one.message) for one in recwarn if one.category is RuntimeWarning]


def test_what_is_no_exception_is_one_line_too(capsys: pytest.CaptureFixture[str]) -> None:
    status, text = checked("Panics-v0", capsys, "--steps", "50")
    assert status == 1
    assert "fault: the environment's step raises CancelledError: panic (test_env_check.py, line " in text


def test_a_second_one_is_tried_with_an_action_that_the_first_one_stood(capsys: pytest.CaptureFixture[str]) -> None:
    status, text = checked("Normed-v0", capsys, "--steps", "50")
    assert status == 0
    assert "no second one" not in text


def test_times_are_the_agents_steps(capsys: pytest.CaptureFixture[str]) -> None:
    text = checked("Pendulum-v1", capsys, "--steps", "100", "--action-repeat", "4")[1]
    assert "time limit 50\n" in text
    assert "2 episodes of 50 steps" in text


def test_what_cannot_be_made_is_one_line(capsys):
    assert main.run(["check-env", "CartPole-v1"]) == 2
    assert "actions are Discrete" in capsys.readouterr().err
    assert main.run(["check-env", "HalfCheetah-v5", "--steps", "0"]) == 2


def test_what_options_take_away_is_no_fault(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--drop-sensors", "0.3", "--flicker", "0.2", "--flicker-burst", "4", "--delay", "3", "--steps", "100"]
    status, printed = checked("Pendulum-v1", capsys, *words)
    assert status == 0
    assert "observations 3, actions 1, time limit 200" in printed
    assert "no episode ended" not in printed
    (share,) = re.findall(r"(\d+)% of what is observed is missing", printed)
    assert 25 <= int(share) <= 65  # 1 - 0.7 * 0.8 is 44
    assert "fault" not in printed


@pytest.mark.parametrize(
    ("env", "words"),
    [
        ("tests.partial_env:Partial-v0", 'info["privileged"] has 2 numbers, which critics alone read'),
        ("Untold-v0", '--privileged-critic would end in: the environment\'s info["privileged"] is not finite'),
        ("Late-v0", '--privileged-critic would end in: the environment\'s info["privileged"] has shape (2,), at first'),
    ],
)
def test_what_critics_alone_may_read_is_noted(env: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    status, text = checked(env, capsys, "--steps", "100")
    assert status == 0
    assert f"note: {words}" in text
