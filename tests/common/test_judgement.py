"""What a user's environment may give and do, and that every command says the same of it."""

import asyncio
import dataclasses
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box

from rmc.common.env import wrappers
from rmc.common.env.config import EnvConfig, read_kwargs, write_kwargs
from rmc.common.env.make import env_layout, make_env
from rmc.common.env.spaces import vector
from rmc.common.errors import ConfigError, EnvFault
from tests import habits


def habit(name: str, **options: Any) -> EnvConfig:
    return EnvConfig(f"tests.habits:{name}-v0", env_kwargs=options)


@pytest.fixture(autouse=True)
def _all_warnings() -> Iterator[None]:
    wrappers._warn_once.cache_clear()
    yield
    wrappers._warn_once.cache_clear()


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
@pytest.mark.parametrize("bound", [1.0, 0.1])
def test_an_environment_gets_an_action_of_its_own(dtype: str, bound: float) -> None:
    """It may change it, also while a step is repeated; it is in its action space, outermost ones too."""
    config = EnvConfig("tests.habits:InPlace-v0", action_repeat=3, env_kwargs={"dtype": dtype, "bound": bound})
    env = make_env(config)
    env.reset(seed=0)
    for given in ([1.0, -1.0], [0.25, 0.5]):
        action = np.array(given, np.float32)
        env.step(action)
        assert action.tolist() == given
        taken = env.unwrapped.taken[-3:]  # type: ignore[attr-defined]
        assert [one.dtype.name for one in taken] == [dtype] * 3
        np.testing.assert_allclose(taken, [[value * bound for value in given]] * 3, rtol=1e-3)


@pytest.mark.parametrize("shape", ["column", "row", "nested", "tuple"])
def test_numbers_of_any_shape_are_a_vector(shape: str) -> None:
    env, plain = make_env(habit("Shaped", shape=shape)), make_env(habit("Shaped", shape="plain"))
    layout = env_layout(habit("Shaped", shape=shape))
    assert (layout.obs_dim, layout.action_dim) == (3, 2)
    assert env.reset(seed=3)[0].tolist() == plain.reset(seed=3)[0].tolist()
    for _ in range(3):
        seen = env.step(np.array([0.5, -1.0], np.float32))[0]
        assert seen.shape == (3,)
    assert seen[2] == 3.0
    bounds = {"column": (1.0, -2.0), "row": (0.5, -1.0), "nested": (1.5, -1.0), "tuple": (0.5, 0.0)}[shape]
    assert seen[1] == pytest.approx(0.3 * sum(bounds), rel=1e-5)


WRONG = [
    (0, None, "observation is None; return an array of numbers"),
    (0, ["1", "2", "3"], "observation is ['1', '2', '3']; return an array of numbers"),
    (0, [1.0, [2.0]], "observation is [1.0, [2.0]]; return an array of numbers"),
    (0, [1.0, 2.0], "observation has shape (2,), its space says (3,)"),
    (0, [1e39, 1.0, -1e39], "observation is not finite at [0, 2]; return finite numbers that float32 holds"),
    (1, "1", "reward is '1'; return a number"),
    (1, None, "reward is None; return a number"),
    (1, [1.0, 2.0], "reward is [1.0, 2.0]; return a number"),
    (1, 10**30, "reward is 1000000000000000000000000000000; return a number"),
    (2, "False", "terminated is 'False'; return a bool"),
    (2, 0.5, "terminated is 0.5; return a bool"),
    (3, None, "truncated is None; return a bool"),
    (3, 2, "truncated is 2; return a bool"),
    (4, None, "info is None; return a dict, {} if it says nothing"),
    (4, [], "info is []; return a dict, {} if it says nothing"),
    (4, {"missing": "no"}, "info[\"missing\"] is 'no'; return a bool"),
    (4, {"missing": [True, False]}, 'info["missing"] has shape (2,); return a bool, or an array of 3 bools'),
    (
        4,
        {"missing": [True, False, True]},
        'info["missing"] is an array, at its first reset it was none; '
        "return an array from the first reset on, or bools alone",
    ),
]


@pytest.mark.parametrize(("part", "value", "says"), WRONG)
def test_what_a_step_gives_is_judged(part: int, value: Any, says: str) -> None:
    env = make_env(habit("Gives", part=part, value=value))
    env.reset(seed=0)
    env.step(np.zeros(2, np.float32))
    with pytest.raises(EnvFault) as caught:
        env.step(np.zeros(2, np.float32))
    assert str(caught.value) == f"the environment's {says}"


def test_a_mask_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    assert vector(Box(-5.0, 5.0, (2,)), np.ma.masked_array([1.0, 2.0])).tolist() == [1.0, 2.0]  # none masks anything
    monkeypatch.setattr(habits.Slide, "seen", lambda _: np.ma.masked_array([1.0, 2.0, 3.0], [True, False, False]))
    with pytest.raises(EnvFault, match=r'is a masked array; return zeros where it masks, and say so in info\["missing'):
        make_env(habit("Slide")).reset()


@pytest.mark.parametrize("error", [SystemExit, asyncio.CancelledError])  # or a Rust library's panic
def test_whatever_a_step_raises_is_its_fault(error: type[BaseException], monkeypatch: pytest.MonkeyPatch) -> None:
    def step(*_: Any) -> Any:
        raise error("panic")

    monkeypatch.setattr(habits.Slide, "step", step)
    env = make_env(habit("Slide"))
    env.reset()
    with pytest.raises(EnvFault, match=rf"^the environment's step raises {error.__name__}: panic \(test_judgement"):
        env.step(np.zeros(2, np.float32))


def test_ctrl_c_in_a_step_is_nobodys_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    def step(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(habits.Slide, "step", step)
    env = make_env(habit("Slide"))
    env.reset()
    with pytest.raises(KeyboardInterrupt):
        env.step(np.zeros(2, np.float32))


@pytest.mark.parametrize(("part", "value"), [(1, [0.5]), (1, 1), (1, True), (2, [0]), (4, {"missing": 0})])
def test_what_means_the_same_is_taken(part: int, value: Any) -> None:
    env = make_env(habit("Gives", part=part, value=value))
    env.reset(seed=0)
    for _ in range(3):
        _, reward, terminated, _, _ = env.step(np.zeros(2, np.float32))
    assert terminated is False
    assert type(reward) is float


def test_the_older_way_of_gym_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(habits.Slide, "step", lambda *_: (np.zeros(3), 0.0, False, {}))
    env = make_env(dataclasses.replace(habit("Slide"), time_limit=9))
    env.reset()
    with pytest.raises(EnvFault, match=r"step gives 4 values; return \(observation, reward, terminated"):
        env.step(np.zeros(2, np.float32))
    monkeypatch.setattr(habits.Slide, "reset", lambda *_, **__: np.zeros(3))
    with pytest.raises(EnvFault, match=r"reset gives a ndarray; return \(observation, info\)"):
        env.reset()


def test_a_close_that_raises_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(3):
        make_env(habit("CannotClose")).close()
    (message,) = [record for record in caplog.records if record.levelno == logging.WARNING]
    assert message.getMessage().startswith(
        "the environment's close raises RuntimeError: already closed (habits.py, line "
    )


def test_the_innermost_place_in_the_users_file_is_named() -> None:
    env = make_env(habit("Stumbles"))
    env.reset()
    lines = Path(habits.__file__).read_text().splitlines()
    line = 1 + next(i for i, text in enumerate(lines) if text.endswith("# the line that must be named"))
    with pytest.raises(EnvFault) as caught:
        env.step(np.zeros(2, np.float32))
    assert str(caught.value) == (f"the environment's step raises LinAlgError: Singular matrix (habits.py, line {line})")


def test_keywords_are_typed_and_written_as_they_are_read() -> None:
    words = [
        "goal=1.5",
        "least=.5",
        "tag=1_000",
        "map=007",
        "limit=inf",
        "gap=NaN",
        "minus=-Infinity",
        "wide=\N{FULLWIDTH DIGIT ONE}",
        "whole=2.",
        "more=+5",
        "most=-1e3",
        "size=3",
        "name=maze",
        "at=[0, 1]",
        "deep=true",
        "no=None",
        'text="3"',
        "empty=",
        "e=a=b",
    ]
    kwargs = read_kwargs(words)
    assert kwargs == {
        "goal": 1.5, "least": 0.5, "tag": "1_000", "map": "007", "limit": "inf", "gap": "NaN", "minus": "-Infinity",
        "wide": "\N{FULLWIDTH DIGIT ONE}", "whole": 2.0, "more": 5, "most": -1000.0, "size": 3, "name": "maze",
        "at": [0, 1], "deep": True, "no": None, "text": "3", "empty": "", "e": "a=b",
    }  # fmt: skip
    assert read_kwargs(write_kwargs(kwargs)) == kwargs


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["goal"], "--env-kwargs='goal': write NAME=VALUE"),
        (["a-b=1"], "--env-kwargs='a-b=1'"),
        (["a=1", "a=2"], "a is there twice"),
        (["a=[b,c]"], "no JSON; keep its quotes from the shell"),
        (["a=[NaN]"], "no JSON"),
        (["a=1", "b=-1e999"], "--env-kwargs b=-inf: take finite numbers"),
    ],
)
def test_other_words_are_refused(words: list[str], says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_kwargs(words)
    assert says in str(caught.value)


@pytest.mark.parametrize("text", ["{robot}", "[a", "[1, 2]", "{}", "3", "007", "inf", "true", "None", " 5", '"x"', ""])
def test_text_comes_back_as_text_whatever_it_looks_like(text: str) -> None:
    assert read_kwargs(write_kwargs({"name": text})) == {"name": text}


def test_a_missing_keyword_comes_with_its_remedy() -> None:
    with pytest.raises(ConfigError) as caught:
        env_layout(habit("Wants"))
    assert "missing a required argument: 'goal'; it takes (goal: float, size: int = 3" in str(caught.value)
    assert "give --env-kwargs NAME=VALUE" in str(caught.value)
    assert env_layout(habit("Wants", goal=1.5, size=5)).obs_dim == 5


@pytest.mark.parametrize("env", ["mine.py:Mine-v0", "./mine.py:Mine-v0", "/home/me/mine.py:Mine-v0"])
def test_a_file_in_place_of_a_module_comes_with_the_right_name(env: str) -> None:
    with pytest.raises(ConfigError, match="give the module's name, not its file: mine:Mine-v0, from the folder that"):
        make_env(EnvConfig(env))


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("pkg/mine", "pkg.mine"),
        ("./mine", "mine"),
        ("../pkg/mine", "mine"),
        ("/home/me/mine", "mine"),
        ("{here}/pkg/mine", "pkg.mine"),
        (".mine", "mine"),
    ],
)
def test_a_path_in_place_of_a_module_comes_with_the_right_name(
    path: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pkg").mkdir()
    (tmp_path / "pkg" / "mine.py").touch()
    says = f"give the module's name, not its path: {name}:Mine-v0, from the folder that holds {name.split('.')[0]}"
    with pytest.raises(ConfigError, match=f"{says}$"):
        make_env(EnvConfig(f"{path.format(here=tmp_path)}:Mine-v0"))


@pytest.mark.parametrize("env", ["mine", "mine.Mine-v0", "./mine.py", "mine.py"])
def test_a_module_in_place_of_an_id_comes_with_how_to_give_it(
    env: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="no such environment; use a gymnasium id or module:EnvId-v0"):
        make_env(EnvConfig(env))
    (tmp_path / "mine.py").touch()
    with pytest.raises(ConfigError, match=r"no such environment; mine\.py is here: give mine:EnvId-v0"):
        make_env(EnvConfig(env))


@pytest.mark.parametrize(
    ("env", "says"),
    [
        ("LateSpaces", "spaces raises AttributeError: 'LateSpaces' object has no attribute 'observation"),
        ("NoRobot", "the environment's spaces raises RuntimeError: no robot answers (habits.py, line "),
        ("NoModule", "the environment cannot be made: ModuleNotFoundError: No module named 'tests.nowhere'"),
        ("Mistyped", "the environment cannot be made: TypeError: can only concatenate str"),
    ],
)
def test_faults_of_its_making_are_one_line(env: str, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        env_layout(habit(env))
    assert says in str(caught.value)
    assert env in ("LateSpaces", "NoModule") or "habits.py, line " in str(caught.value)
