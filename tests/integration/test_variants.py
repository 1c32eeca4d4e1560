"""Every variant trains: the whole system in lockstep, for some updates, and ends as it should."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest

from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.local.lockstep import Lockstep
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.presets import debug
from rmc.deploy.run.validation import validate
from tests.integration.test_lockstep import trained

STEPS, WARMUP = 500, 200


def config(env: str = "InvertedPendulum-v5", **options: Any) -> RunConfig:
    """A short run with some options of its parts changed, by name."""
    run = dataclasses.replace(debug(EnvConfig(env)), total_steps=STEPS)
    changes = {"replay": {"replay_ratio": 4.0, "warmup_steps": WARMUP}, "learner": {"batch_size": 4}}
    for name in ("env", "window", "agent", "actor", "replay", "update", "learner"):
        part = getattr(run, name)
        own = {key: value for key, value in options.items() if hasattr(part, key)}
        run = dataclasses.replace(run, **{name: dataclasses.replace(part, **changes.get(name, {}) | own)})
        options = {key: value for key, value in options.items() if key not in own}
    assert not options, f"no such options: {options}"
    validate(run)
    return run


VARIANTS: list[dict[str, Any]] = [
    {"scheme": 4},  # what changes the update alone is compared with a plain one in tests/learner/test_variants.py
    {"stride": 5},
    {"priority_exponent": 0.0, "importance_exponent": 0.0},
    {"initial_priority": "actor", "n_step": 3},
    {"embedding": 0, "grounding": False},
    {"head_input": "hidden+observation", "normalize_observations": True},
    {"flicker": 0.5},
    {"flicker": 0.5, "missing_flag": True, "normalize_observations": True},
    {"flicker": 0.5, "impute_missing": True, "normalize_observations": True},
    {"flicker": 0.5, "impute_missing": True, "normalize_observations": True, "initial_priority": "actor"},
    {"flicker": 0.5, "flicker_burst": 4.0, "delay": 2, "impute_missing": True, "normalize_observations": True},
    {"drop_sensors": 0.3, "frame_stack": 2},
    {"hide": "velocities"},
    {"hide": "positions"},
    {"noise": 0.1},
    {"frame_stack": 3},
    {"reward_scale": 0.1},
    {"action_repeat": 2},
    {"time_limit": 20},
]


def check(run: RunConfig, lockstep: Lockstep) -> dict[str, Any]:
    """That it was trained to its end, at its ratio, and is finite; its learner's metrics."""
    stats, learner = lockstep.server.stats(), lockstep.learner
    assert learner.updates > 0
    assert stats["env_steps"] == STEPS
    batch = run.learner.batch_size * run.window_spec().train
    debt = run.replay.replay_ratio * (STEPS - WARMUP) - stats["drawn_steps"]
    assert -(run.replay.replay_ratio * run.slack_steps() + batch) <= debt <= batch
    assert all(value.isfinite().all() for value in learner.agent.state_dict().values())
    metrics = learner.metrics()
    assert all(math.isfinite(value) for value in metrics.values() if isinstance(value, float))
    return metrics


@pytest.mark.parametrize("options", VARIANTS, ids=lambda options: "-".join(f"{k}={v}" for k, v in options.items()))
def test_a_variant_trains(options: dict[str, Any], tmp_path: Path) -> None:
    run = config(**options)
    check(run, trained(run, tmp_path))


def test_actors_rate_their_windows_once_there_is_something_to_rate_them_by(tmp_path: Path) -> None:
    run = config(initial_priority="actor", capacity=1_000)
    check(run, lockstep := trained(run, tmp_path))
    rows = lockstep.server._store.ring.rows[: lockstep.server.stats()["windows"]]
    by_actor, random = (
        rows["initial_priority"][mask] for mask in (rows["weights_update"] > 0, rows["weights_update"] == 0)
    )
    assert len(by_actor) > 10
    assert (by_actor > 0).all()
    assert len(random) > 10
    assert (random == 0).all()


@pytest.mark.parametrize(
    ("strategy", "stages"),
    [("burn-in", {"stored", "burned"}), ("stored", {"stored"}), ("zero", {"stored"}), ("episode", set())],
)
def test_staleness_is_measured(strategy: str, stages: set[str], tmp_path: Path) -> None:
    run = config(env="Reacher-v5", state_strategy=strategy, batch_size=16, replay_ratio=64.0)
    metrics = check(run, trained(run, tmp_path))
    stale = {name: value for name, value in metrics.items() if name.startswith("stale_")}
    assert set(stale) == {f"stale_{what}_{stage}" for what in ("state", "q_first", "q_last") for stage in stages}
    assert all(0.0 <= value < 10.0 for value in stale.values())
    if strategy == "zero":
        assert stale["stale_state_stored"] == pytest.approx(1.0)
    assert metrics["sample_age_mean"] >= 0.0


def test_initial_priorities_need_priorities() -> None:
    with pytest.raises(ConfigError, match=r"--initial-priority=.actor.: uniform replay"):
        config(initial_priority="actor", priority_exponent=0.0)


def test_an_episode_strategy_needs_a_time_limit() -> None:
    with pytest.raises(ConfigError, match=r"--state-strategy=.*no time limit"):
        config("tests.counting_env:Counting-v0", state_strategy="episode").window_spec()
