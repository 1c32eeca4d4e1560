"""Presets, the strict JSON round trip, and the one place that judges numbers."""

import dataclasses
import json
import math
from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmc.common.agent_config import HeadInput
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import Preset, RunConfig, to_json
from rmc.deploy.run.option_names import flat, option
from rmc.deploy.run.presets import debug, memory, paper, preset_config, robust
from rmc.deploy.run.validation import validate, validate_new
from tests.runs import read_config

ENV = EnvConfig("InvertedPendulum-v5")
NAMES: list[Preset] = ["robust", "memory", "paper", "debug"]


@pytest.mark.parametrize("name", NAMES)
def test_presets_are_valid_and_come_back_from_json(name: Preset) -> None:
    config = preset_config(name, ENV)
    validate(config)
    assert config.preset == name
    assert read_config(to_json(config)) == config


def test_the_paper_preset_is_the_papers() -> None:
    config = paper(ENV)
    assert (config.agent.embedding, config.agent.heads, config.agent.grounding) == (0, (400, 300), False)
    assert (config.update.learning_rate, config.update.alpha_learning_rate) == (1e-4, 1e-5)
    assert (config.update.curiosity, config.update.curiosity_scale) == (0.5, "raw")
    assert (config.update.gamma, config.update.polyak, config.update.policy_q) == (0.99, 0.995, "first")
    assert config.replay.warmup_steps == 10_000


def test_the_memory_preset_has_whole_episodes_as_windows() -> None:
    config = memory(EnvConfig("tests.memory_env:Memory40-v0", time_limit=44))
    spec = config.window_spec()
    assert (spec.burn_in, spec.train) == (0, 44)
    assert config.agent.gate_init == "chrono"
    assert not config.update.halves_are_apart()
    assert config.actor == dataclasses.replace(robust(ENV).actor, state_strategy="episode")


@given(
    st.floats(1e-6, 0.1),
    st.integers(1, 10**9),
    st.sampled_from(get_args(HeadInput)),
    st.sampled_from(["online", "ema"]),
)
def test_json_keeps_every_value(rate: float, steps: int, head_input: Any, target: Any) -> None:
    config = robust(ENV)
    config = dataclasses.replace(
        config,
        total_steps=steps,
        agent=dataclasses.replace(config.agent, head_input=head_input, heads=(7, 5)),
        update=dataclasses.replace(config.update, learning_rate=rate, target_memory=target),
    )
    assert read_config(to_json(config)) == config


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("surprise", 1, "no such option"),
        ("agent.surprise", 1, "no such option"),
        ("seed", "1", "must be int"),
        ("seed", True, "must be int"),
        ("agent.heads", [1], r"must be tuple\[int, int\]"),
        ("agent.heads", [1, "2"], "must be int"),
        ("agent.missing_flag", 1, "must be bool"),
        ("update.policy_q", "third", "must be one of 'first', 'min'"),
        ("update.gamma", "0.99", "must be float"),
        ("env", 5, "must be an object"),
    ],
)
def test_strange_json_is_refused(path: str, value: Any, message: str) -> None:
    raw = json.loads(to_json(robust(ENV)))
    parent, _, name = path.rpartition(".")
    (raw[parent] if parent else raw)[name] = value
    with pytest.raises(ConfigError, match=message) as caught:
        read_config(json.dumps(raw))
    assert path.split(".")[0] in str(caught.value)


def test_missing_values_and_broken_files_are_refused() -> None:
    raw = json.loads(to_json(robust(ENV)))
    del raw["replay"]["capacity"]
    with pytest.raises(ConfigError, match=r"replay\.capacity"):
        read_config(json.dumps(raw))
    with pytest.raises(ConfigError, match="not JSON"):
        read_config(b"{")


def numeric_paths() -> list[str]:
    values = flat(robust(ENV))
    return [path for path, value in values.items() if isinstance(value, int | float) and not isinstance(value, bool)]


def with_value(config: RunConfig, path: str, value: Any) -> RunConfig:
    parent, _, name = path.rpartition(".")
    if not parent:
        return dataclasses.replace(config, **{name: value})
    part = dataclasses.replace(getattr(config, parent), **{name: value})
    return dataclasses.replace(config, **{parent: part})


@pytest.mark.parametrize("value", [-1, math.nan, math.inf])
@pytest.mark.parametrize("path", numeric_paths())
def test_every_number_is_judged(path: str, value: float) -> None:
    value *= 101 if path == "update.target_entropy" else 1  # which may be negative
    with pytest.raises(ConfigError) as caught:
        validate(with_value(robust(ENV), path, value))
    assert path.rpartition(".")[2].replace("_", "-") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_values_that_do_not_go_together_are_refused() -> None:
    config = robust(ENV)
    with pytest.raises(ConfigError, match="--stride=16"):
        validate(with_value(config, "actor.stride", 16))
    with pytest.raises(ConfigError, match="--total-steps"):
        validate(with_value(config, "total_steps", config.replay.warmup_steps))
    with pytest.raises(ConfigError, match="--stride=5: an episode is one window"):
        validate(with_value(with_value(config, "actor.stride", 5), "actor.state_strategy", "episode"))
    longer = with_value(config, "window.trained_steps", 100)
    with pytest.raises(ConfigError, match="--trained-steps=100: an episode is one window"):
        validate_new(with_value(longer, "actor.state_strategy", "episode"))
    validate_new(longer)
    for strategy in ("episode", "zero", "stored"):
        burnt = with_value(with_value(config, "window.burn_in", 40), "actor.state_strategy", strategy)
        with pytest.raises(ConfigError, match=f"--burn-in=40: --state-strategy {strategy} has no burn-in"):
            validate_new(burnt)
        validate(burnt)  # a run that has it goes on
    farther = with_value(config, "update.n_step", 16)
    with pytest.raises(ConfigError, match=r"--n-step=16: .* at most --trained-steps=15"):
        validate_new(farther)
    validate(farther)
    validate_new(with_value(farther, "window.trained_steps", 16))
    validate_new(with_value(farther, "actor.state_strategy", "episode"))
    flagged = with_value(with_value(config, "agent.missing_flag", True), "agent.head_input", "observation")
    for idle, name in ((flagged, "missing-flag"), (with_value(config, "env.flicker_burst", 5.0), "flicker-burst")):
        with pytest.raises(ConfigError, match=f"--{name}=.*; (leave it|give --flicker)"):
            validate_new(idle)
        validate(idle)
    for used in ("env.flicker", "env.drop_sensors"):
        validate_new(with_value(with_value(config, "env.flicker_burst", 5.0), used, 0.3))
    with pytest.raises(ConfigError, match="--missing-flag"):
        validate(with_value(with_value(config, "agent.missing_flag", True), "env.frame_stack", 2))
    with pytest.raises(ConfigError, match=r"--impute-missing=True: .*--normalize-observations; .*--no-impute-missing"):
        validate(with_value(config, "agent.normalize_observations", False))
    with pytest.raises(ConfigError, match="--policy-through-q"):
        validate(with_value(config, "update.policy_through_q", False))
    with pytest.raises(ConfigError, match=r"--replay-shards=2: .*--actors=1"):
        validate(with_value(config, "replay.replay_shards", 2))
    with pytest.raises(ConfigError, match=r"--actors=3: .*multiple of --replay-shards=2"):
        validate(with_value(with_value(config, "actors", 3), "replay.replay_shards", 2))
    with pytest.raises(ConfigError, match="--heads"):
        validate(with_value(config, "agent.heads", (400, 0)))


def test_a_window_that_no_redis_would_take_is_refused() -> None:
    config = with_value(robust(EnvConfig("InvertedPendulum-v5", time_limit=2**31)), "actor.state_strategy", "episode")
    with pytest.raises(ConfigError, match=r"--time-limit=2147483648: .* more than 32 MiB; take at most \d+"):
        config.window_spec()


@pytest.mark.parametrize("strategy", ["burn-in", "episode"])
def test_the_longest_window_that_is_named_is_taken_and_no_longer_one(strategy: str) -> None:
    env = EnvConfig("HumanoidStandup-v5", frame_stack=10, time_limit=10_000, action_repeat=2)
    config = with_value(robust(env), "actor.state_strategy", strategy)
    config = with_value(config, "window.trained_steps", 10_000)
    with pytest.raises(ConfigError, match="take at most") as caught:
        config.window_spec()
    most = int(str(caught.value).rpartition(" ")[2])
    path = "env.time_limit" if strategy == "episode" else "window.trained_steps"
    step = 2 if strategy == "episode" else 1
    assert with_value(config, path, most).window_spec().train * step == most
    with pytest.raises(ConfigError, match=f"take at most {most}$"):
        with_value(config, path, most + step).window_spec()
    with pytest.raises(ConfigError, match=r"--burn-in=10000: .* smaller observations"):
        with_value(with_value(config, "window.burn_in", 10_000), "actor.state_strategy", "burn-in").window_spec()


@pytest.mark.parametrize(
    ("path", "value"),
    [("replay.capacity", 0), ("replay.replay_ratio", 0.0), ("actor.envs_per_actor", 0), ("actor.chunk_windows", 0)],
)
def test_a_number_out_of_range_is_named(path: str, value: float) -> None:
    with pytest.raises(ConfigError, match=option(path)):
        validate(with_value(debug(EnvConfig("Pendulum-v1")), path, value))
