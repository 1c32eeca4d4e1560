"""Lockstep: same seed, same bits; and the same bits again across checkpoint, stop and resume."""

import dataclasses
import shutil
from pathlib import Path

import pytest
import torch

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.env.config import EnvConfig
from rmc.common.errors import RmcError
from rmc.common.process.role import StopSignal
from rmc.deploy.local.lockstep import Lockstep, train
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.presets import debug
from rmc.learner.config import LearnerConfig
from rmc.learner.update import JointUpdate
from rmc.replay_server.config import ReplayConfig
from tests.raising import raising

CONFIG = dataclasses.replace(
    debug(EnvConfig("InvertedPendulum-v5")),
    seed=5,
    actors=2,
    total_steps=1_500,
    replay=ReplayConfig(capacity=60, replay_ratio=8.0, warmup_steps=200),  # wraps
    learner=LearnerConfig(batch_size=8, checkpoint_steps=400, precision="fp32"),
)


pytestmark = pytest.mark.usefixtures("one_thread")


def trained(config: RunConfig, folder: Path, stop_after_checkpoints: int = 0) -> Lockstep:
    lockstep = Lockstep(config, folder)
    checkpoints, seen = 0, lockstep.learner.last_checkpoint
    while not lockstep.learner.finished:
        lockstep.step()
        if lockstep.learner.last_checkpoint != seen:
            checkpoints, seen = checkpoints + 1, lockstep.learner.last_checkpoint
            if checkpoints == stop_after_checkpoints:
                break
    lockstep.close()
    return lockstep


def bits(lockstep: Lockstep) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in lockstep.learner.agent.state_dict().items()}


def assert_same(a: Lockstep, b: Lockstep) -> None:
    assert a.learner.updates == b.learner.updates
    torch.testing.assert_close(bits(a), bits(b), rtol=0, atol=0)
    theirs = b.server.stats()
    assert {key: value for key, value in a.server.stats().items() if not key.endswith("_s")} == {
        key: value for key, value in theirs.items() if not key.endswith("_s")
    }


@pytest.fixture(scope="module")
def straight(tmp_path_factory) -> Lockstep:
    torch.set_num_threads(1)
    return trained(CONFIG, tmp_path_factory.mktemp("straight"))


def test_same_seed_same_bits_also_after_a_stop(straight, tmp_path):
    assert straight.learner.updates > 100
    stopped = trained(CONFIG, tmp_path, stop_after_checkpoints=2)
    assert 0 < stopped.learner.updates < straight.learner.updates
    assert_same(straight, trained(CONFIG, tmp_path))


def test_counters_stay_where_the_ring_is_lost(tmp_path: Path) -> None:
    stopped = trained(CONFIG, tmp_path, stop_after_checkpoints=1)
    shutil.rmtree(tmp_path / "replay")
    again = Lockstep(CONFIG, tmp_path)
    counts = [one.server.stats()["env_steps"] for one in (stopped, again)]
    again.close()
    assert counts[0] == counts[1] >= 400


def test_a_start_that_fails_leaves_no_lock(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        fails = raising(RmcError("cannot be made beside the others"))
        patch.setattr("rmc.deploy.local.lockstep.make_evaluator", fails)
        with pytest.raises(RmcError, match="beside the others"):
            Lockstep(CONFIG, tmp_path)
    Lockstep(CONFIG, tmp_path).close()


def test_the_ratio_and_the_total_are_kept(straight):
    stats = straight.server.stats()
    slack = CONFIG.slack_steps()
    assert CONFIG.total_steps <= stats["env_steps"] <= CONFIG.total_steps + slack
    debt = (stats["env_steps"] - 200) * 8.0 - stats["drawn_steps"]
    batch = 8 * 15
    assert -(slack * 8.0 + batch) <= debt <= batch


def test_batches_that_are_cut_give_the_same_bits_across_a_stop(tmp_path, monkeypatch):
    """Whole episodes as windows: most end early, so that updates run over a part of them."""
    lengths, planned = [], JointUpdate.plan

    def plan(*given):
        made = planned(*given)
        lengths.append(made.steps)
        return made

    monkeypatch.setattr(JointUpdate, "plan", plan)
    actor = dataclasses.replace(CONFIG.actor, state_strategy="episode")
    config = dataclasses.replace(
        CONFIG, env=EnvConfig("InvertedPendulum-v5", time_limit=100), actor=actor, total_steps=1_000
    )
    straight = trained(config, tmp_path / "straight")
    stopped = trained(config, tmp_path / "stopped", stop_after_checkpoints=1)
    assert 1 < stopped.learner.updates < straight.learner.updates
    assert min(lengths) < config.window_spec().steps == max(lengths)
    assert_same(straight, trained(config, tmp_path / "stopped"))


def test_an_evaluation_is_played_step_by_step_between_which_a_signal_is_heard(tmp_path):
    lockstep = Lockstep(CONFIG, tmp_path)
    while not lockstep.learner.last_checkpoint:
        lockstep.step()
    updates = lockstep.learner.updates
    for _ in range(20):  # an episode has more
        lockstep.step()
    assert not lockstep.finished
    assert lockstep.learner.updates == updates
    lockstep.close()


def test_the_last_checkpoint_is_evaluated_too(tmp_path):
    said: list[dict[str, float]] = []
    heard = {"evaluator": "0", "learner": "0"}
    config = dataclasses.replace(CONFIG, total_steps=600)
    train(config, tmp_path, lambda bus: said.extend(bus.records(heard)[0]), StopSignal())
    evaluated = {record["eval_update"] for record in said if "eval_update" in record}
    assert evaluated >= set(CheckpointFolder(tmp_path / "checkpoints").numbers())  # the newest are kept
    assert [record for record in said if record["role"] == "learner"][-1]["finished"] == 1
