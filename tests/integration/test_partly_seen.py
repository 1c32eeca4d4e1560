"""Whole runs whose sensors are missing one by one, and whose critics see more, from the environment to the file."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import safetensors.torch
import torch

from rmc.analysis.evaluation import evaluate_policy, initial_policy
from rmc.analysis.policy import load_policy
from rmc.analysis.policy_file import read_policy
from rmc.cli import main
from rmc.common.errors import ConfigError
from rmc.common.window import Rows
from rmc.deploy.local.lockstep import Lockstep
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import open_run
from tests.deploy.test_warm_start import begin, state
from tests.integration.test_lockstep import assert_same, trained
from tests.integration.test_variants import STEPS, config

ENV = "tests.partial_env:Partial-v0"
AGENT = {"normalize_observations": True, "impute_missing": True, "missing_flag": True, "privileged_critic": True}

pytestmark = pytest.mark.usefixtures("one_thread")


def partial(**options: Any) -> RunConfig:
    return config(ENV, capacity=200, **AGENT | options)


def rows_of(lockstep: Lockstep) -> tuple[Rows, np.ndarray]:
    """Its windows, and (n, T + 1) which of their observations are real."""
    rows = lockstep.server._store.ring.rows[: lockstep.server.stats()["windows"]]
    t = np.arange(lockstep.server.spec.observations)
    return rows, (rows["first"][:, None] <= t) & (t <= rows["last"][:, None])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"impute_missing": False},
        {"normalize_observations": False, "impute_missing": False},
        {"update_order": "alternate", "scheme": 4},
        {"scheme": 3, "initial_priority": "actor", "policy_ema_updates": 100},
        {"target_memory": "ema", "latent_target": "ema", "head_input": "hidden+observation"},
    ],
)
def test_it_trains_and_its_windows_say_what_was_seen(options: dict[str, Any], tmp_path: Path) -> None:
    lockstep = trained(partial(**options), tmp_path)
    assert all(value.isfinite().all() for value in lockstep.learner.agent.state_dict().values())
    rows, real = rows_of(lockstep)
    missing, observation, privileged = (rows[name][real] for name in ("missing", "observation", "privileged"))
    assert 0.2 < missing.mean() < 0.4
    assert not observation[missing == 1].any()
    for number, scale in ((0, 1.0), (1, 10.0)):
        seen = missing[:, number] == 0
        np.testing.assert_allclose(scale * observation[seen, number], privileged[seen, number], rtol=1e-5)
    if AGENT | options == AGENT:  # each number is normalised by what was seen of it
        statistics = lockstep.server.statistics()
        assert statistics.count.shape == (5,)
        mean = torch.from_numpy(statistics.total / statistics.count).float()
        torch.testing.assert_close(lockstep.learner.agent.normalizer.mean, mean[:3])
        torch.testing.assert_close(lockstep.learner.agent.privileged_normalizer.mean, mean[3:])


def test_a_run_that_goes_on_has_the_same_bits(tmp_path: Path) -> None:
    """Priorities of actors, too: they take random actions, whose generator begins anew with each epoch."""
    longer = partial(scheme=3, initial_priority="actor", checkpoint_steps=200)
    straight = trained(longer, tmp_path / "straight")
    trained(longer, tmp_path / "stopped", stop_after_checkpoints=1)
    assert_same(straight, trained(longer, tmp_path / "stopped"))


def test_its_policy_knows_what_is_missing_and_nothing_of_what_critics_see(tmp_path: Path) -> None:
    """Its file, an evaluation, a loop of one's own and ONNX; sent to actors are the networks that act alone."""
    settings = partial(checkpoint_steps=200)
    folder = open_run(settings, LaunchOptions(tmp_path / "run", "fail"))
    lockstep = trained(settings, folder.path)
    folder.lock.release()
    sent = lockstep.bus.weights()
    assert sent is not None
    policy = load_policy(folder.path)
    header = read_policy(folder.path).header
    assert (header.layout.missing, header.layout.privileged) == (3, 2)
    for weights in (sent[1], read_policy(folder.path).blob, initial_policy(settings)):
        names = {name.partition(".")[0] for name in safetensors.torch.load(weights)}
        assert names == {"normalizer", "memory", "policy", "next_frame"}
    assert np.isfinite(evaluate_policy(read_policy(folder.path), episodes=2)["eval_return_mean"])
    env = policy.make_env()
    observation, info = env.reset(seed=3)
    assert main.run(["export", str(folder.path), "--out", str(tmp_path / "policy.onnx")]) == 0
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"), providers=["CPUExecutionProvider"])
    feed = {
        "previous_action": np.zeros((1, 1), np.float32),
        "state": np.zeros((1, header.sizes()["state"]), np.float32),
    }
    for step in range(10):
        given = observation.copy()
        if step == 5:
            given[1] = np.nan  # as good as missing
        action = policy.act(given, info["missing"])
        by_onnx, state = session.run(None, {"observation": given[None], "missing": info["missing"][None], **feed})
        np.testing.assert_allclose(by_onnx[0], action, atol=1e-5)
        feed = {"previous_action": by_onnx, "state": state}
        observation, *_, info = env.step(action)
    policy.reset()
    batch = np.zeros((2, 3), np.float32)
    whole = policy.act(batch, np.array([True, False]))
    policy.reset()
    assert (whole == policy.act(batch, np.array([[True] * 3, [False] * 3]))).all()
    with pytest.raises(ConfigError, match=r"missing='of shape .2, 2.': give one, or one for each of 2 rows, or 3 for"):
        policy.act(batch, np.zeros((2, 2), bool))
    assert main.run(["inspect", str(folder.path), "--out", str(tmp_path / "inspect.png")]) == 0


def test_a_run_whose_critics_see_more_begins_with_another(tmp_path: Path) -> None:
    """All of it, its normaliser included; or, without what critics see, what remembers and predicts."""
    settings = partial(checkpoint_steps=200)
    source = open_run(settings, LaunchOptions(tmp_path / "source", "fail"))
    trained(settings, source.path)
    source.lock.release()
    theirs, other = state(source)["agent"], dataclasses.replace(settings, seed=9)
    for parts, learnt in (("all", True), ("memory+world-model", False)):
        begun = Lockstep(other, begin(other, tmp_path / parts, source, parts).path)
        before, ours = begun.learner._observed_before, begun.learner.agent.state_dict()
        assert before.count.tolist() == [STEPS] * 3 + [STEPS * learnt] * 2
        assert torch.equal(ours["memory.gru.weight_hh_l0"], theirs["memory.gru.weight_hh_l0"])
        name = "privileged_normalizer.mean"
        assert torch.equal(ours[name], theirs[name]) == learnt
        begun.close()
    blind = dataclasses.replace(settings, agent=dataclasses.replace(settings.agent, privileged_critic=False))
    with pytest.raises(ConfigError, match=r"that run has --privileged-critic True, this one has False; use the same"):
        begin(blind, tmp_path / "blind", source)
