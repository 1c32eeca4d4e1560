"""A counting environment through every hop, with every role a process of its own, started by hand.

The test is the learner: it publishes the weights and draws until it has every window.
"""

import dataclasses
import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rmc.actors.config import ActorConfig
from rmc.analysis.evaluation import initial_policy
from rmc.common.bus.protocol import Version
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.env.config import EnvConfig
from rmc.common.replay import SampleStatus
from rmc.deploy.run.config import to_registration
from rmc.deploy.run.presets import debug
from rmc.learner.replay.client import ReplayClient
from rmc.replay_server.config import ReplayConfig
from tests.command import COMMAND
from tests.counting_env import Step, audit

SECONDS = 90.0
BATCH = 64
ENOUGH_STEPS = 2_000
CONFIG = dataclasses.replace(
    debug(EnvConfig("tests.counting_env:Counting-v0")),
    total_steps=1_000_000,
    actors=2,
    actor=ActorConfig(envs_per_actor=4),
    replay=ReplayConfig(capacity=4_000, replay_ratio=2_000.0, warmup_steps=0, priority_exponent=0.0),
    learner=dataclasses.replace(debug(EnvConfig("x")).learner, batch_size=BATCH),
)


@pytest.fixture
def bus(redis_url: str, run_name: str) -> RedisBus:
    redis_bus = RedisBus(redis_url, run_name)
    redis_bus.set_config(to_registration(CONFIG))
    redis_bus.publish_weights(Version(redis_bus.take_epoch("learner"), 1), initial_policy(CONFIG))
    return redis_bus


@pytest.fixture
def client(bus: RedisBus, redis_url: str, run_name: str, tmp_path: Path) -> Iterator[ReplayClient]:
    (tmp_path / "secret").write_text("every hop")
    place = ["--run", run_name, "--redis-url", redis_url]
    listen = [
        "--folder",
        str(tmp_path / "replay"),
        "--listen",
        f"unix:{tmp_path}/s",
        "--secret-file",
        str(tmp_path / "secret"),
    ]
    roles = [
        ["role", "replay", *place, *listen],
        *(["role", "actor", *place, "--index", str(index)] for index in range(CONFIG.actors)),
    ]
    processes = [subprocess.Popen([*COMMAND, *words], env=os.environ) for words in roles]
    replay = ReplayClient(lambda: f"unix:{tmp_path}/s", b"every hop", CONFIG.window_spec(), BATCH)
    replay.register_learner(bus.current_epoch("learner"))  # only the newest learner is served
    yield replay
    replay.close()
    bus.request_stop("the test is over")
    assert [process.wait(30) for process in processes] == [0, 0, 0]


def draw_everything(client: ReplayClient, steps: int) -> np.ndarray:
    """All windows of at least so many steps, by serial, as batches brought them."""
    windows: dict[int, np.void] = {}
    drawn_steps = 0
    deadline = time.monotonic() + SECONDS
    while time.monotonic() < deadline:
        sample = client.sample(BATCH)
        if sample.status is not SampleStatus.BATCH:
            time.sleep(0.01)
            continue
        assert sample.rows is not None
        for row in sample.rows.copy():
            windows[int(row["serial"])] = row
        drawn_steps = sum(int(row["new_steps"]) for row in windows.values())
        actors = {int(row["actor"]) for row in windows.values()}
        if sample.env_steps >= steps and drawn_steps >= sample.env_steps and len(actors) == CONFIG.actors:
            return np.array([windows[serial] for serial in sorted(windows)])
    raise AssertionError(f"{drawn_steps} steps after {SECONDS} s; the server has {sample.env_steps}")


def test_each_step_is_trained_once(client: ReplayClient) -> None:
    rows = draw_everything(client, ENOUGH_STEPS)
    counts = audit(rows, CONFIG.window_spec())
    assert set(counts.trained.values()) == {1}, "a step was doubled"
    assert len(counts.trained) == counts.new_steps >= ENOUGH_STEPS, "a step was lost"
    assert len({name.env for name in counts.trained}) == CONFIG.actors * CONFIG.actor.envs_per_actor
    assert_whole_episodes(set(counts.trained))
    assert rows["serial"].tolist() == list(range(len(rows)))
    assert len({(row["actor"], row["epoch"], row["seq"], row["k"]) for row in rows}) == len(rows)


def assert_whole_episodes(trained: set[Step]) -> None:
    """Every episode is there from its first step on without a gap, and so are an environment's episodes."""
    longest: dict[tuple[int, int], int] = {}
    for name in trained:
        longest[name.env, name.episode] = max(longest.get((name.env, name.episode), 0), name.step)
    assert len(trained) == sum(last + 1 for last in longest.values())
    for env in {env for env, _ in longest}:
        episodes = [episode for other, episode in longest if other == env]
        assert sorted(episodes) == list(range(max(episodes) + 1))
