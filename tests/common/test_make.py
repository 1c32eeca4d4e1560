"""Environments: what comes out, what is refused in one line, and that MuJoCo keeps quiet."""

import json
import math
import os
import re
import subprocess
import sys
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from gymnasium.spaces import Box
from gymnasium.wrappers import TransformObservation

from rmc.common.env.config import EnvConfig
from rmc.common.env.make import env_layout, first_env, further_env, make_env, recreate_env
from rmc.common.errors import ConfigError, RmcError
from tests.counting_env import CountingEnv
from tests.memory_env import ANSWER_STEPS

REPOSITORY = Path(__file__).parents[2]


class OddSpaces(gym.Env[Any, Any]):
    """A user's environment with spaces as given."""

    def __init__(self, observation: gym.Space[Any], action: gym.Space[Any]) -> None:
        self.observation_space, self.action_space = observation, action
        self.last_action: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.last_action = action
        return self.observation_space.sample(), 0.0, False, False, {}


VECTOR = Box(-1.0, 1.0, (3,), np.float64)
gym.register("OddSpaces-v0", entry_point=OddSpaces)


def longer() -> gym.Env[Any, Any]:
    """A body of MuJoCo's whose observation says one number more than the body knows of."""
    space = Box(-np.inf, np.inf, (5,), np.float64)
    return TransformObservation(InvertedPendulumEnv(), lambda observation: np.append(observation, 1.0), space)


def limited() -> gym.Env[Any, Any]:
    """Cut off at 20 steps by a wrapper of the user's own."""
    return gym.wrappers.TimeLimit(OddSpaces(VECTOR, Box(-1.0, 1.0, (2,))), 20)


class Trials(gym.Wrapper[Any, Any, Any, Any]):
    """Episodes of what it wraps, one after the other, as one."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        if truncated:
            observation, info = self.env.reset()
        return observation, reward, terminated, False, info


class OlderBox(gym.Space[Any]):
    """Of gym, before it was gymnasium."""


OlderBox.__name__, OlderBox.__module__ = "Box", "gym.spaces.box"
gym.register("Longer-v0", entry_point=longer)
gym.register("LimitedWithin-v0", entry_point=limited)
gym.register("Trials-v0", entry_point=lambda: Trials(limited()))


def odd(name: str, observation: gym.Space[Any], action: gym.Space[Any]) -> EnvConfig:
    gym.registry.pop(name, None)
    gym.register(name, entry_point=OddSpaces, kwargs={"observation": observation, "action": action})
    return EnvConfig(name)


@pytest.mark.parametrize(
    ("told", "names"),
    [
        (["pos", "vel"], [""]),
        ("pos", [""]),
        ({"pos": (3,)}, [""]),
        ({"pos": np.int64(1), "vel": 2}, ["pos", "vel"]),
    ],
    ids=str,
)
def test_what_an_environment_calls_the_parts_of_its_observation(
    told: Any, names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or something else of that name."""
    monkeypatch.setattr(OddSpaces, "observation_structure", told, raising=False)
    layout = env_layout(odd("OddParts-v0", VECTOR, Box(-1.0, 1.0, (2,))))
    assert [part["name"] for part in json.loads(json.dumps(asdict(layout)))["observations"]] == names


def test_a_property_of_the_environments_that_raises_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(OddSpaces, "observation_structure", property(lambda _: 1 // 0), raising=False)
    with pytest.raises(ConfigError, match=r"observation_structure raises ZeroDivisionError.*test_make"):
        env_layout(odd("OddParts-v0", VECTOR, Box(-1.0, 1.0, (2,))))


@pytest.mark.parametrize("hide", ["positions", "velocities"])
@pytest.mark.parametrize(
    "told", [{"a": 1, "b": 2}, {"qpos": 3}, {"qvel": 1, "qpos": 2}, {"qpos": 0, "qvel": 3}], ids=str
)
def test_parts_are_hidden_where_positions_come_first_and_more_follows(
    told: dict[str, int], hide: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(OddSpaces, "observation_structure", told, raising=False)
    config = replace(odd("OddParts-v0", VECTOR, Box(-1.0, 1.0, (2,))), hide=hide)
    with pytest.raises(ConfigError, match=rf"^ENV='OddParts-v0': it does not say which observations are {hide}; "):
        env_layout(config)


def test_a_wrong_mujoco_gl_ends_only_what_needs_mujoco() -> None:
    code = """
from rmc.common.env.config import EnvConfig
from rmc.common.env.make import first_env
first_env(EnvConfig("Pendulum-v1")).close()
first_env(EnvConfig("InvertedPendulum-v5"))
"""
    environment = {**os.environ, "MUJOCO_GL": "nonsense"}
    told = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=100)
    last = told.stderr.splitlines()[-1]
    assert re.fullmatch(r"rmc\.common\.errors\.ConfigError: ENV='InvertedPendulum-v5': .*MUJOCO_GL: nonsense.*", last)


def test_mujoco_environment() -> None:
    layout = env_layout(EnvConfig("HalfCheetah-v5"))
    assert (layout.obs_dim, layout.action_dim, layout.time_limit) == (17, 6, 1000)
    env = make_env(EnvConfig("HalfCheetah-v5"))
    observation, info = env.reset(seed=3)
    assert observation.dtype == np.float32
    assert "missing" not in info
    reference = gym.make("HalfCheetah-v5")
    expected, _ = reference.reset(seed=3)
    np.testing.assert_allclose(observation, expected, rtol=1e-6)
    action = np.linspace(-1, 1, 6, dtype=np.float32)
    for _ in range(5):
        ours, theirs = env.step(action), reference.step(action)
        np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-5)
        assert ours[1] == pytest.approx(theirs[1])
    env.close()
    reference.close()


def test_time_limit_is_kept() -> None:
    env = make_env(EnvConfig("HalfCheetah-v5"))
    env.reset(seed=0)
    ends = [env.step(np.zeros(6, np.float32))[2:4] for _ in range(1000)]
    assert ends == [(False, False)] * 999 + [(False, True)]
    env.close()


@pytest.mark.parametrize("limit", [1e3, -1, 0, np.int64(100)], ids=str)
def test_a_registered_time_limit_is_a_whole_number(limit: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    config = odd("Limited-v0", VECTOR, Box(-1.0, 1.0, (2,)))
    monkeypatch.setattr(gym.spec(config.id), "max_episode_steps", limit)
    if limit == 100:
        first_env(config).close()
        assert env_layout(config).time_limit == 100
        return
    fix = "register a whole number from 1 on, or None"
    with pytest.raises(ConfigError, match=rf"^ENV='Limited-v0': its max_episode_steps is {limit}; {fix}$"):
        first_env(config)
    first_env(replace(config, time_limit=7)).close()


def test_a_limit_of_the_users_own_wrapper_is_known() -> None:
    within = EnvConfig("LimitedWithin-v0")
    for config, steps in (
        (within, 20), (replace(within, time_limit=7), 7), (replace(within, action_repeat=3), 7),
    ):  # fmt: skip
        assert env_layout(config).time_limit == steps
        env = make_env(replace(config, delay=steps - 2))
        env.reset(seed=0)
        assert [env.step(np.zeros(2, np.float32))[3] for _ in range(steps)] == [False] * (steps - 1) + [True]
        fix = f"an episode ends after {steps} steps; take fewer than {steps - 1}"
        for late in (steps - 1, steps):  # with the first of both, too, every action sees the first observation alone
            with pytest.raises(ConfigError, match=rf"^--delay={late}: {fix}$"):
                make_env(replace(config, delay=late))


def test_a_users_own_wrapper_may_go_on_past_a_limit_within_it() -> None:
    for config in (EnvConfig("Trials-v0"), EnvConfig("Trials-v0", time_limit=60)):
        env = make_env(config)
        env.reset(seed=0)
        ends = [env.step(np.zeros(2, np.float32))[3] for _ in range(60)]
        assert ends == [False] * 59 + [config.time_limit == 60]


def test_one_that_is_refused_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[Any] = []
    monkeypatch.setattr(OddSpaces, "close", lambda self: closed.append(self))
    for config in (EnvConfig("LimitedWithin-v0", delay=20), odd("Whole-v0", VECTOR, Box(0, 3, (2,), np.int64))):
        with pytest.raises(ConfigError):
            make_env(config)
        assert len(closed) == 1
        closed.clear()


def test_numbers_of_another_byte_order_are_numbers() -> None:
    layout = env_layout(odd("Foreign-v0", Box(-1.0, 1.0, (3,), np.dtype(">f4")), Box(-1.0, 1.0, (2,))))
    assert layout.observations[0].dtype == "float32"


def test_actions_are_stretched_and_clipped() -> None:
    low, high = np.array([-2.0, 0.0]), np.array([2.0, 10.0])
    env = make_env(odd("Stretched-v0", VECTOR, Box(low, high, dtype=np.float64)))
    inner = env.unwrapped
    assert isinstance(inner, OddSpaces)
    observation, _ = env.reset(seed=0)
    assert observation.dtype == np.float32
    assert (env.action_space.low, env.action_space.high) == (pytest.approx(-1), pytest.approx(1))  # type: ignore[attr-defined]
    for given, wanted in (([-1, -1], low), ([1, 1], high), ([0, 0], (low + high) / 2), ([-9, 9], [-2.0, 10.0])):
        env.step(np.array(given, np.float32))
        np.testing.assert_allclose(inner.last_action, wanted)
        assert inner.last_action.dtype == np.float64


@pytest.mark.parametrize("bound", [0.1, 1 / 3, 1e-5, 1e5])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_outermost_actions_are_within_the_bounds(bound: float, dtype: type) -> None:
    space = Box(-bound, bound, (2,), dtype)
    env = make_env(odd(f"Bound{bound}{dtype.__name__}-v0", VECTOR, space))
    inner = env.unwrapped
    assert isinstance(inner, OddSpaces)
    env.reset(seed=0)
    for given in (-1.0, 1.0, np.tanh(np.float32(9.0)), np.nextafter(np.float32(1), np.float32(2))):
        env.step(np.full(2, given, np.float32))
        assert space.contains(inner.last_action)
        np.testing.assert_allclose(inner.last_action, np.clip(given, -1, 1) * bound, rtol=1e-6)


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (EnvConfig("HalfCheeta-v5"), "did you mean HalfCheetah-v5"),
        (EnvConfig("HalfCheetah"), "did you mean HalfCheetah-v5? One of your own"),
        (EnvConfig("Qxzzy-v9"), "no such environment"),
        (EnvConfig("ALE/Pong-v5"), "no such environment; use a gymnasium id or module:EnvId-v0"),
        (EnvConfig("no_such_module:Thing-v0"), "No module named 'no_such_module'"),
        (EnvConfig("CartPole-v1"), "actions are Discrete"),
        (EnvConfig("tests.memory_env:Memory13-v0"), "did you mean Memory12-v0"),
        (EnvConfig("HalfCheetah-v5", flicker=1.5), "take a number from 0 to 1"),
        (EnvConfig("HalfCheetah-v5", flicker=math.nan), "take a number from 0 to 1"),
        (odd("Image-v0", Box(0, 255, (8, 8, 3), np.uint8), VECTOR), "images (8, 8, 3)"),
        (odd("Dict-v0", gym.spaces.Dict(a=VECTOR, b=gym.spaces.Discrete(3)), VECTOR), "{'b': 'Discrete'} are no Box"),
        (odd("Pictures-v0", gym.spaces.Dict(a=VECTOR, b=Box(0, 255, (9, 8, 3), np.uint8)), VECTOR), "{'b': (9, 8, 3)}"),
        (odd("Tuple-v0", gym.spaces.Tuple([VECTOR, gym.spaces.Text(3)]), VECTOR), "{'1': 'Text'} are no Box"),
        (
            odd("Film-v0", Box(0, 1, (4, 84, 84)), VECTOR),
            "images (4, 84, 84); only vectors are learnt from: give what an",
        ),
        (odd("Gray-v0", Box(0, 255, (9, 8), np.uint8), VECTOR), "images (9, 8)"),
        (
            odd("Eye-v0", gym.spaces.Dict(a=gym.spaces.Dict(b=Box(0, 1, (64, 64)))), VECTOR),
            "{'a.b': (64, 64)} are images",
        ),
        (odd("Still-v0", VECTOR, Box(np.float32([-1, 0.5]), np.float32([1, 0.5]))), "its actions [1] cannot move"),
        (
            odd("Many-v0", VECTOR, gym.spaces.Dict(a=VECTOR, b=gym.spaces.Discrete(2))),
            "of its actions {'b': 'Discrete'}",
        ),
        (EnvConfig("Pendulum-v1", hide="velocities"), "--hide is for MuJoCo's bodies"),
        (EnvConfig("tests.common.test_make:Longer-v0", hide="velocities"), "--hide is for MuJoCo's bodies"),
        (EnvConfig("HalfCheetah-v5", noise=-0.1), "--noise=-0.1"),
        (EnvConfig("HalfCheetah-v5", env_timeout=math.inf), "--env-timeout=inf: take a number from 0.1 to"),
        (EnvConfig("HalfCheetah-v5", frame_stack=0), "--frame-stack=0"),
        (EnvConfig("HalfCheetah-v5", action_repeat=0), "--action-repeat=0"),
        (EnvConfig("HalfCheetah-v5", time_limit=-1), "--time-limit=-1"),
        (odd("Empty-v0", Box(0, 1, (0,), np.float32), VECTOR), "its observations have shape (0,)"),
        (odd("Unbounded-v0", VECTOR, Box(-np.inf, np.inf, (2,))), "action space is unbounded"),
        (odd("Endless-v0", VECTOR, Box(-3e38, 3e38, (2,))), "action space reaches 3e+38; give it a Box with the low"),
        (
            odd("Hollow-v0", gym.spaces.Dict(a=VECTOR, b=gym.spaces.Dict()), VECTOR),
            "observations {'b': 'Dict'} are no",
        ),
        (odd("Idle-v0", VECTOR, gym.spaces.Tuple([VECTOR, gym.spaces.Tuple([])])), "of its actions {'1': 'Tuple'} are"),
        (odd("None-v0", gym.spaces.Dict(), VECTOR), "its observations have shape None: there are none"),
        (odd("Older-v0", OlderBox(), VECTOR), "its observations are gym.spaces.box.Box; RMC takes a Box of numbers"),
        (odd("Whole-v0", VECTOR, Box(0, 3, (2,), np.int64)), "actions are int64"),
        (EnvConfig("json:Nothing-v0"), "json/__init__.py) registers no Nothing-v0"),
        (odd("Multi-v0", VECTOR, gym.spaces.MultiDiscrete([2, 2])), "actions are MultiDiscrete"),
        (EnvConfig("Pendulum-v1", env_kwargs={"g": math.inf}), "--env-kwargs g=inf: take finite numbers"),
        (EnvConfig("Pendulum-v1", env_kwargs={"gg": 9}), "unexpected keyword argument 'gg'; it takes (render_mode"),
    ],
    ids=lambda value: value.id if isinstance(value, EnvConfig) else "",
)
def test_refused_in_one_line(config: EnvConfig, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make_env(config)
    message = str(caught.value)
    assert says in message
    assert "\n" not in message
    assert message.startswith(("ENV=", "--"))


def test_an_unknown_id_is_no_module_of_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "__init__.py").touch()
    with pytest.raises(ConfigError, match=r"^ENV='HalfCheeta-v5': no such environment; did you mean HalfCheetah-v5"):
        make_env(EnvConfig("HalfCheeta-v5"))
    with pytest.raises(ConfigError, match="start from the folder that holds aaa"):
        make_env(EnvConfig(f"{'a' * 300}:Mine-v0"))


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("import nothere", "No module named 'nothere'; broken needs it; install it"),
        ("x = (", "broken cannot be imported: SyntaxError: '(' was never closed (broken.py, line 1)"),
        ("x = 1\nx / 0", "broken cannot be imported: ZeroDivisionError: division by zero (broken.py, line 2)"),
        ("import json\njson.loads('x')", "Expecting value: line 1 column 1 (char 0) (broken.py, line 2)"),
        ("import sys\nsys.exit('no licence')", "broken cannot be imported: SystemExit: no licence (broken.py, line 2)"),
        (
            "import asyncio\nraise asyncio.CancelledError('panic')",
            "broken cannot be imported: CancelledError: panic (broken.py, line 2)",
        ),
        (
            "import asyncio, gymnasium\nclass Env(gymnasium.Env):\n  def __init__(self): raise asyncio.CancelledError\n"
            "gymnasium.register('Broken-v0', entry_point=Env)",
            "the environment cannot be made: CancelledError (broken.py, line 3)",
        ),
        (
            "import gymnasium\nclass Env(gymnasium.Env):\n  def __init__(self):\n    self.x\n"
            "gymnasium.register('Broken-v0', entry_point=Env)",
            "the environment cannot be made: AttributeError: 'Env' object has no attribute 'x' (broken.py, line 4)",
        ),
    ],
)
def test_a_users_broken_module_is_one_line_with_its_place(source: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text(source)
    run = _python(tmp_path, "from rmc.common.env.make import *; env_layout(EnvConfig('broken:Broken-v0'))")
    assert says in run.stderr.splitlines()[-1]
    assert run.stderr.splitlines()[-1].startswith("rmc.common.errors.ConfigError: ENV='broken:Broken-v0': ")


def test_a_users_module_in_the_working_folder_does_not_shadow_ours(tmp_path: Path) -> None:
    (tmp_path / "common.py").write_text("raise SystemExit('shadowed')")
    (tmp_path / "mine.py").write_text(
        "import gymnasium\n"
        "from gymnasium.envs.classic_control import PendulumEnv\n"
        "gymnasium.register('Mine-v0', entry_point=PendulumEnv, max_episode_steps=7)\n"
    )
    run = _python(
        tmp_path,
        "from rmc.common.env.make import *; layout = env_layout(EnvConfig('mine:Mine-v0')); "
        "print((layout.obs_dim, layout.action_dim, layout.time_limit))",
    )
    assert (run.returncode, run.stdout.strip()) == (0, "(3, 1, 7)"), run.stderr


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Humanoid-v5"])
def test_mujoco_prints_nothing_and_leaves_no_file(tmp_path: Path, env_id: str) -> None:
    run = _python(
        tmp_path, f"from rmc.common.env.make import *; make_env(EnvConfig({env_id!r})).reset(seed=0); print('made')"
    )
    assert (run.stdout, run.stderr) == ("made\n", "")
    assert list(tmp_path.iterdir()) == []


def _python(folder: Path, code: str) -> subprocess.CompletedProcess[str]:
    """Run code in a folder, as an installed command would: the repository on the path, the folder not."""
    prelude = f"import sys; sys.path = [p for p in sys.path if p]; sys.path.insert(0, {str(REPOSITORY)!r}); "
    return subprocess.run(
        [sys.executable, "-c", prelude + code], cwd=folder, capture_output=True, text=True, check=False
    )


def test_flicker_hides_the_whole_observation_and_nothing_else() -> None:
    flickering, clear = (make_env(EnvConfig("HalfCheetah-v5", flicker=p)) for p in (0.5, 0.0))
    flickering.reset(seed=1)
    clear.reset(seed=1)
    action = np.full(6, 0.3, np.float32)
    blanks = []
    for _ in range(50):
        seen, reward, _, _, info = flickering.step(action)
        truth, true_reward, *_ = clear.step(action)
        np.testing.assert_array_equal(seen, 0.0 * truth if info["missing"] else truth)
        assert reward == true_reward
        blanks.append(info["missing"])
    assert 0 < sum(blanks) < 50
    assert all(type(blank) is bool for blank in blanks)


@pytest.mark.parametrize("delay", [12, 40])
def test_memory_task_needs_a_memory(delay: int) -> None:
    """Remembering reaches the best return; without, half of the episodes cost what the others gain."""
    env = make_env(EnvConfig(f"tests.memory_env:Memory{delay}-v0"))
    env.reset(seed=0)
    remembered, blind = [], []
    for episode in range(200):
        for returns, forgets in ((remembered, False), (blind, True)):
            observation, _ = env.reset(seed=episode)
            cue, total, steps, ended = observation[0], 0.0, 0, False
            assert abs(cue) == 1.0
            while not ended:
                action = 1.0 if forgets else cue
                observation, reward, ended, _, _ = env.step(np.array([action], np.float32))
                assert ended or observation[0] == 0.0
                total, steps = total + reward, steps + 1
            assert steps == delay + ANSWER_STEPS
            returns.append(total)
    assert min(remembered) == ANSWER_STEPS
    assert abs(np.mean(blind)) < 4 * ANSWER_STEPS / math.sqrt(200)


def test_what_a_further_environment_is_refused_for_stays_a_refusal() -> None:
    """On a node that lacks its module, for one."""
    with pytest.raises(ConfigError, match="no_such_module"):
        further_env(lambda: make_env(EnvConfig("no_such_module:Thing-v0")), "an environment of actor-0's 8")
    with pytest.raises(RmcError, match="an environment of actor-0's 8 cannot be made beside the others"):
        further_env(lambda: [][0], "an environment of actor-0's 8")


def test_one_that_its_module_keeps_is_made_anew_as_it_is() -> None:
    """A robot, of which there is one: nothing of it is taken apart."""
    kept = gym.Wrapper(CountingEnv())
    gym.register("Kept-v0", lambda: kept)
    make = partial(make_env, EnvConfig("Kept-v0"))
    recreate_env(make(), make, None).reset(seed=0)


def test_a_callers_own_error_keeps_its_traceback() -> None:
    make = partial(make_env, EnvConfig("tests.counting_env:Counting-v0"))
    theirs, error = KeyError("theirs"), RuntimeError("the simulation is unstable")
    try:
        raise theirs
    except KeyError:
        with pytest.raises(RuntimeError):
            raise error from theirs
        recreate_env(make(), make, error)
    assert theirs.__traceback__ is not None
