"""The learner role against a real replay server in the same thread."""

import dataclasses
import io
import json
import sys
import time

import numpy as np
import pytest
import safetensors.torch
import torch

from rmc.common.agent_config import AgentConfig
from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.bus.protocol import EntryId
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import BusUnavailable, CheckpointError, FencedError, RmcError
from rmc.common.wire import encode_hello, encode_windows
from rmc.learner.config import LearnerConfig, UpdateConfig
from rmc.learner.diagnostics import latent_rank
from rmc.learner.learner import Learner
from rmc.learner.learner_checkpoint import all_finite
from rmc.learner.policy_average import MOVE_UPDATES
from rmc.replay_server.config import ReplayConfig
from rmc.replay_server.server import ReplayServer
from tests.hostile import hostile_state
from tests.learner.rows import SPEC, observation_valid, random_rows, step_valid

AGENT = AgentConfig(hidden=SPEC.state, embedding=7, heads=(10, 9), normalize_observations=True)
CONFIG = LearnerConfig(batch_size=8, publish_updates=4, checkpoint_steps=2_000, precision="fp32")


class Setting:
    """A replay server fed by hand, and a learner on it."""

    def __init__(self, folder, total_steps=10_000, replay_ratio=2.0):
        self.bus, self.folder, self.seq = MemoryBus(), folder, 0
        self.server = ReplayServer(
            SPEC, ReplayConfig(1000, replay_ratio, warmup_steps=50), folder / "replay", 0, total_steps, 1, 100, self.bus
        )
        self.bus.append(0, EntryId(1, 0), encode_hello(SPEC))
        self.learner = self.start()

    def start(self, policy_ema_updates: int = 0, threads: tuple[int, ...] = ()) -> Learner:
        checkpoints, update = (
            CheckpointFolder(self.folder / "checkpoints"),
            UpdateConfig(policy_ema_updates=policy_ema_updates),
        )
        return Learner(SPEC, AGENT, update, CONFIG, self.server, self.bus, checkpoints, seed=1, threads=threads)

    def feed(self, windows: int, reward: float = 1.0) -> None:
        rows = random_rows(windows, self.seq)
        rows["reward"] *= reward
        rows["new_steps"] = rows["last"] - SPEC.burn_in
        rows["new_observations"] = rows["new_steps"]
        self.seq += 1
        self.bus.append(0, EntryId(1, self.seq), encode_windows(rows, SPEC))
        while self.server.step():
            pass

    def update(self) -> None:
        """One, after more experience has come."""
        self.feed(60)
        self.learner.step()


@pytest.fixture
def setting(tmp_path):
    fresh = Setting(tmp_path)
    yield fresh
    fresh.learner.close()
    fresh.server.close()


def test_first_weights_are_out_before_any_experience(setting):
    assert setting.bus.latest_version() == (1, 0)
    assert not setting.learner.step()
    assert setting.learner.waiting_for() == "experience"


@pytest.mark.parametrize("start", ["uniform", "chrono"])
def test_gates_start_as_the_agent_says(start, tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "AGENT", dataclasses.replace(AGENT, gate_init=start))
    fresh = Setting(tmp_path)
    gru = fresh.learner.agent.memory.gru
    update_gates = (gru.bias_ih_l0 + gru.bias_hh_l0)[gru.hidden_size : 2 * gru.hidden_size]
    assert bool((update_gates >= 0.0).all()) is (start == "chrono")
    fresh.learner.close()
    fresh.server.close()


@pytest.mark.usefixtures("one_thread")
def test_a_resumed_learner_takes_the_threads_that_were_chosen(setting):
    setting.learner.close()
    setting.learner = setting.start(threads=(1, 2))
    setting.learner._threads.take_up(2)  # as if a trial had found it
    setting.feed(20)
    assert setting.learner.step()
    assert setting.learner.metrics()["threads"] == torch.get_num_threads() == 2
    setting.learner.close()
    setting.learner = setting.start(threads=(1, 2))
    assert setting.learner.metrics()["threads"] == torch.get_num_threads() == 2
    setting.learner.close()
    setting.learner = setting.start(threads=(1, 4))
    assert setting.learner.metrics()["threads"] == 0
    assert torch.get_num_threads() == 1


def test_weights_that_redis_forgot_are_out_again(setting):
    setting.bus._weights.clear()
    setting.learner._acting._look_at = 0.0
    assert not setting.learner.step()
    assert setting.bus.latest_version() == (1, 0)


@pytest.mark.parametrize(("left", "waits"), [("nothing", True), ("an older one", False)])
def test_an_evaluation_that_redis_forgot_is_asked_for_again(setting, monkeypatch, left, waits):
    monkeypatch.setattr("rmc.learner.broadcast.LOOK_SECONDS", 0.0)
    setting.update()
    before = setting.bus._weights[True] = setting.bus._weights[False]
    setting.feed(60)
    while setting.learner.step():
        pass
    setting.learner.checkpoint()
    asked, number = setting.bus.weights(evaluate=True), setting.learner.updates
    setting.bus._weights.clear()
    if left == "an older one":
        setting.bus._weights[True] = before
    if not waits:
        setting.feed(60)
    assert setting.learner.step() is not waits
    assert setting.bus.weights(evaluate=True) == asked
    assert asked[0] == (1, number)


def test_weights_that_an_outage_kept_back_are_sent_after_it(setting, monkeypatch):
    """Redis may come back with the ones before."""

    def away(*_):
        raise BusUnavailable("connection refused")

    monkeypatch.setattr(setting.bus, "publish_weights", away)
    with pytest.raises(BusUnavailable):
        setting.learner.publish()
    setting.feed(60)
    assert setting.learner.step()  # what it has, it learns from until then
    setting.learner._acting._look_at = 0.0
    sent = []
    monkeypatch.setattr(setting.bus, "publish_weights", lambda version, *_: sent.append(version))
    assert setting.learner.step()
    assert sent == [(1, 0)]


@pytest.mark.parametrize("away", [False, True], ids=["what acts", "what is evaluated"])
def test_a_checkpoint_in_an_outage_sends_both_after_it(setting, monkeypatch, away):
    setting.update()
    publish, saved = setting.bus.publish_weights, setting.learner.updates

    def one_is_lost(version, blob, evaluate):
        if evaluate == away:
            raise BusUnavailable("connection refused")
        publish(version, blob, evaluate)

    monkeypatch.setattr(setting.bus, "publish_weights", one_is_lost)
    with pytest.raises(BusUnavailable):
        setting.learner.checkpoint()
    monkeypatch.setattr(setting.bus, "publish_weights", publish)
    setting.learner._acting._look_at = 0.0
    setting.learner.step()
    assert {setting.bus.latest_version(evaluate) for evaluate in (False, True)} == {(1, saved)}


def test_weights_older_than_the_last_that_redis_has_are_replaced(setting):
    first = setting.bus._weights[False]
    setting.feed(60)
    while setting.learner.step():
        pass
    newest = setting.bus.latest_version()
    assert newest.update >= 8
    setting.bus._weights[False] = first  # its log lacks the last second
    setting.learner._acting._look_at = 0.0
    assert not setting.learner.step()
    assert setting.bus.latest_version() == (1, setting.learner.updates) >= newest


def test_updates_publish_and_give_priorities_back(setting):
    setting.feed(60)
    before = setting.server.stats()["max_priority"]
    while setting.learner.step():
        pass
    assert setting.learner.updates > 8
    assert setting.bus.latest_version().update == setting.learner.updates // 4 * 4
    assert setting.server.stats()["max_priority"] != before


def test_statistics_are_frozen_into_what_is_published(setting):
    setting.update()
    setting.learner.publish()
    weights = safetensors.torch.load(setting.bus.weights()[1])
    statistics = setting.server.statistics()
    mean = torch.from_numpy(statistics.total / statistics.count).float()
    torch.testing.assert_close(weights["normalizer.mean"], mean)
    assert set(weights) == set(setting.learner.agent.policy_weights())


def test_statistics_stay_while_the_replay_server_is_away(setting, monkeypatch):
    setting.update()
    before = setting.learner.agent.normalizer.mean.clone()
    assert before.any()
    monkeypatch.setattr(setting.learner.replay, "statistics", lambda: None)
    setting.learner.publish()
    assert torch.equal(setting.learner.agent.normalizer.mean, before)


def test_checkpoint_holds_the_policy_and_resumes(setting):
    setting.feed(60)
    while setting.learner.step():
        pass
    setting.learner.close()
    number, files = setting.learner.checkpoints.latest()
    assert number == setting.learner.updates
    assert json.loads(files["progress.json"])["env_steps"] == setting.learner.env_steps
    resumed = setting.start()
    assert (resumed.updates, resumed.env_steps) == (setting.learner.updates, setting.learner.env_steps)
    assert resumed.epoch == setting.learner.epoch + 1
    for name, value in setting.learner.agent.state_dict().items():
        assert torch.equal(value, resumed.agent.state_dict()[name]), name
    resumed.finished = True
    resumed.close()


@pytest.mark.parametrize("average", [0, MOVE_UPDATES - 1, 1_000])
def test_what_is_evaluated_and_saved_is_the_average_where_asked_and_actors_have_the_newest(setting, average):
    setting.learner.close()
    learner = setting.learner = setting.start(average)
    setting.feed(200)
    while learner.step():
        pass
    assert learner.updates % MOVE_UPDATES  # so that the newest has moved on since the average did
    learner.publish()
    learner.checkpoint()
    acts, judged = (safetensors.torch.load(setting.bus.weights(evaluate)[1]) for evaluate in (False, True))
    saved = safetensors.torch.load(learner.checkpoints.latest()[1]["policy.safetensors"])
    assert acts.keys() == judged.keys() == saved.keys()
    for name, value in learner.agent.policy_weights().items():
        assert torch.equal(acts[name], value), name
        assert torch.equal(judged[name], saved[name]), name
        assert torch.equal(judged[name], value) == (average < MOVE_UPDATES or name.startswith("normalizer")), name
    learner.close()
    resumed = setting.learner = setting.start(average)
    for name, value in resumed.update.average.policy_weights().items():
        assert torch.equal(value, judged[name]), name


def test_the_average_is_the_newest_until_it_moves_for_the_first_time(setting):
    setting.learner.close()
    learner = setting.learner = setting.start(2_000)
    setting.feed(60)
    while learner.updates < MOVE_UPDATES - 1:
        learner.step()
    newest = learner.agent.policy_weights()
    for name, value in learner.update.average.policy_weights().items():
        assert torch.equal(value, newest[name]), name


def test_no_valid_checkpoint_is_an_error(setting):
    setting.update()
    setting.learner.close()
    for path in setting.folder.glob("checkpoints/0*/learner.pt"):
        path.write_bytes(b"damaged")
    with pytest.raises(CheckpointError, match="no checkpoint is valid"):
        setting.start()


def test_a_newer_checkpoint_that_is_damaged_is_passed_over_and_told(setting):
    setting.update()
    assert setting.learner.metrics()["damaged_checkpoints"] == 0
    setting.learner.close()
    checkpoints = setting.learner.checkpoints
    number, files = checkpoints.latest()
    checkpoints.save(number + 1, files)
    (checkpoints.path(number + 1) / "learner.pt").write_bytes(b"damaged")
    resumed = setting.learner = setting.start()
    assert (resumed.updates, resumed.metrics()["damaged_checkpoints"]) == (number, 1)


def test_a_checkpoint_never_executes_code(setting):
    setting.update()
    setting.learner.close()
    mark = setting.folder / "owned"
    number, files = setting.learner.checkpoints.latest()
    setting.learner.checkpoints.save(number + 1, {**files, "learner.pt": hostile_state(mark)})
    with pytest.raises(CheckpointError, match=r"learner\.pt"):
        setting.start()
    assert not mark.exists()


@pytest.mark.parametrize("state", [None, [], {}, {"agent": None}, {"agent": {}}, {"generator": 3}], ids=str)
def test_a_checkpoint_of_something_else_is_said_to_be_so(setting, state):
    setting.update()
    setting.learner.close()
    file = io.BytesIO()
    number, files = setting.learner.checkpoints.latest()
    if isinstance(state, dict) and "generator" in state:
        state = torch.load(io.BytesIO(files["learner.pt"]), weights_only=True) | state
    if state is not None:
        torch.save(state, file)
    setting.learner.checkpoints.save(number + 1, {**files, "learner.pt": file.getvalue()})
    with pytest.raises(CheckpointError, match=r"learner\.pt is not this run's"):
        setting.start()


@pytest.mark.parametrize("progress", ["", "[]", "{}", '{"updates": "x"}'])
def test_progress_that_makes_no_sense_is_said_to_be_so(setting, progress):
    setting.update()
    setting.learner.close()
    number, files = setting.learner.checkpoints.latest()
    setting.learner.checkpoints.save(number + 1, {**files, "progress.json": progress.encode()})
    with pytest.raises(CheckpointError, match="is not this run's"):
        setting.start()


def test_ends_with_a_checkpoint_once_the_ratio_is_spent(tmp_path):
    setting = Setting(tmp_path, total_steps=100)
    setting.feed(60)
    while not setting.learner.finished:
        assert setting.learner.step()
    assert not setting.learner.step()
    assert setting.learner.checkpoints.numbers()[-1] == setting.learner.updates
    setting.learner.close()
    setting.server.close()


def test_a_replaced_learner_is_fenced(setting):
    setting.update()
    setting.learner.step()
    saved = setting.learner.checkpoints.numbers()
    setting.bus.take_epoch("learner")
    with pytest.raises(FencedError):
        step_for_long(setting)
    setting.learner.close()
    assert setting.learner.checkpoints.numbers() == saved


def test_what_broke_amid_an_update_is_not_saved(setting, monkeypatch):
    """The halves of an update may be of two moments by then."""
    setting.feed(60)
    for _ in range(3):
        setting.learner.step()
    saved = setting.learner.checkpoints.numbers()
    monkeypatch.setattr(setting.learner.update, "actor_critic_pass", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        step_for_long(setting)
    assert setting.learner.updates > 0
    setting.learner.close()
    assert setting.learner.checkpoints.numbers() == saved


def test_the_next_epoch_is_above_the_one_in_the_folder(setting):
    setting.learner.close()
    setting.learner.checkpoints.note_epoch(9)
    setting.learner = setting.start()
    assert setting.learner.epoch == 10
    assert setting.learner.checkpoints.last_epoch() == 10


def test_a_checkpoint_without_room_is_tried_again_and_training_goes_on(setting, monkeypatch):
    setting.update()
    blocked = setting.learner.checkpoints.folder
    blocked.rename(blocked.with_name("away"))
    blocked.write_bytes(b"")  # no folder, so nothing can be made in it
    assert not setting.learner.checkpoint()
    assert setting.learner.metrics()["checkpoint_error"] == "Not a directory"
    updates = setting.learner.updates
    setting.feed(60)
    assert setting.learner.step()
    assert setting.learner.updates == updates + 1
    assert not setting.learner.checkpoint()  # not so soon
    blocked.unlink()
    blocked.with_name("away").rename(blocked)
    monkeypatch.setattr(setting.learner, "_save_at", 0.0)
    assert setting.learner.checkpoint()
    assert setting.learner.metrics()["checkpoint_error"] == ""
    assert setting.learner.checkpoints.numbers()[-1] == updates + 1


def test_while_there_is_no_room_updates_stay_in_flight(setting, monkeypatch):
    """Else two processes would wait for each other at each."""

    def full(number, files):
        raise CheckpointError("as told", "as told")

    learner, drained = setting.learner, []
    monkeypatch.setattr(learner.checkpoints, "save", full)
    monkeypatch.setattr(learner, "_next_checkpoint", 0)
    monkeypatch.setattr(learner._runner, "drain", lambda: drained.append(learner.updates) or [])
    setting.feed(60)
    for _ in range(3):
        assert learner.step()
    assert set(drained) == {1}  # the save that failed


def test_the_last_record_names_what_was_saved_at_the_end(setting, monkeypatch):
    def full(number, files):
        raise CheckpointError("as told", "as told")

    setting.update()
    with monkeypatch.context() as patch:
        patch.setattr(setting.learner.checkpoints, "save", full)
        assert not setting.learner.checkpoint()
    setting.learner.close()
    said = setting.learner.metrics()
    assert setting.learner.checkpoints.numbers() == [said["checkpoint_update"]] == [1]
    assert said["checkpoint_env_steps"] == setting.learner.env_steps > 0
    assert said["checkpoint_error"] == ""


def test_the_end_waits_for_room(tmp_path, monkeypatch):
    setting = Setting(tmp_path, total_steps=100)
    setting.feed(60)
    learner, save = setting.learner, setting.learner.checkpoints.save

    def full(number, files):
        raise CheckpointError("as told", "as told")

    monkeypatch.setattr(learner.checkpoints, "save", full)
    while learner.step():
        assert not learner.finished
    assert (learner.finished, learner.waiting_for()) == (False, "disk")
    monkeypatch.setattr(learner.checkpoints, "save", save)
    monkeypatch.setattr(learner, "_save_at", 0.0)
    assert learner.step()
    assert learner.finished
    learner.close()
    setting.server.close()


def test_divergence_ends_it_and_keeps_the_last_good_checkpoint(setting):
    setting.update()
    saved = setting.learner.checkpoints.numbers()
    with torch.no_grad():
        setting.learner.agent.policy.net[0].weight.fill_(float("nan"))
    with pytest.raises(RmcError, match="not finite"):
        step_for_long(setting)
    setting.learner.close()
    assert setting.learner.checkpoints.numbers() == saved


@pytest.mark.parametrize("size", [1e25, 1e30])
def test_a_divergence_from_huge_rewards_names_their_size(setting, size):
    setting.feed(60, size)
    with pytest.raises(
        RmcError, match=rf"not finite; rewards reach 1e\+{np.log10(size):.0f}: make --reward-scale that"
    ):
        step_for_long(setting)


SPOILT = {
    "a critic": lambda update: update.agent.critic.parameters(),
    "a target critic": lambda update: update.target_critic.parameters(),
    "the world model": lambda update: update.agent.world_model.parameters(),
    "a mean moment": lambda update: [part["exp_avg"] for part in update.optimizers[0].state.values()],
    "a square moment": lambda update: [part["exp_avg_sq"] for part in update.optimizers[0].state.values()],
    "curiosity's variance": lambda update: [update.curiosity_variance],
}


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("part", SPOILT)
def test_nothing_that_is_not_finite_is_saved(setting, part, value):
    setting.update()
    assert setting.learner.checkpoint()
    saved = setting.learner.checkpoints.numbers()
    setting.learner.step()
    with torch.no_grad():
        list(SPOILT[part](setting.learner.update))[-1].view(-1)[-1] = value
    with pytest.raises(RmcError, match=r"update 2: training has diverged, weights are not finite"):
        setting.learner.checkpoint()
    setting.learner.close()
    assert setting.learner.checkpoints.numbers() == saved == [1]
    resumed = setting.start()
    assert resumed.updates == 1
    resumed.finished = True
    resumed.close()


def test_critics_spoilt_by_one_gradient_are_not_saved_though_the_policy_is_sound(setting):
    setting.update()
    weight = next(setting.learner.agent.critic.parameters())
    hook = weight.register_hook(lambda gradient: torch.full_like(gradient, float("inf")))
    setting.learner.step()
    hook.remove()
    assert not weight.isfinite().all()
    assert all(value.isfinite().all() for value in setting.learner.agent.policy_weights().values())
    setting.learner.close()  # which saves what is sound
    assert setting.learner.checkpoints.numbers() == []


def step_for_long(setting: Setting) -> None:
    for _ in range(100):
        setting.update()


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([], True), ([1.0, -2.0], True), ([3e38, 3e38], True), ([0.0, float("nan")], False),
        ([float("inf"), -float("inf")], False), ([3e38, 3e38, -float("inf")], False),
    ],
)  # fmt: skip
def test_large_values_are_finite(values, expected):
    assert all_finite(torch.tensor(values)) is expected


def test_latent_rank_of_what_has_diverged_is_nan():
    assert np.isnan(latent_rank(torch.full((4, 3), torch.nan))).all()


def test_latent_rank_sees_a_collapse():
    torch.manual_seed(0)
    full, _ = latent_rank(torch.randn(20, 10, 16))
    one, deviation = latent_rank(torch.randn(20, 10, 1) * torch.ones(16))
    assert full > 14
    assert one == pytest.approx(1.0, abs=0.01)
    assert deviation > 0.5
    assert latent_rank(torch.ones(4, 5, 16))[1] == 0.0


def test_priorities_of_what_a_gpu_still_works_on_come_later_but_come(setting, monkeypatch):
    setting.feed(60)
    setting.learner._runner.in_flight = 1  # as on a GPU
    returned = []
    monkeypatch.setattr(setting.server, "update_priorities", lambda serials, _: returned.append(serials))
    assert setting.learner.step()
    assert returned == []
    assert setting.learner.step()
    assert len(returned) == 1
    while setting.learner.step():
        pass
    assert len(returned) == setting.learner.updates


def test_how_long_an_update_takes_is_noted_before_there_is_a_checkpoint(setting, monkeypatch):
    """Ctrl-C waits for it."""
    setting.feed(60)
    updated = setting.learner._runner
    whole = type(updated).__call__
    monkeypatch.setattr(type(updated), "__call__", lambda *given: (time.sleep(0.5), whole(*given))[1])
    setting.learner.step()
    assert setting.learner.checkpoints.patience(0.0) >= 3 * 0.5
    monkeypatch.undo()
    setting.learner.step()
    assert setting.learner.checkpoint()
    assert setting.learner.checkpoints.patience(0.0) >= 3 * 0.5  # it may be as slow again


def test_how_long_an_earlier_start_took_to_save_stays_noted(setting):
    setting.feed(60)
    setting.learner.close()
    setting.learner.checkpoints.note_save(3.0)
    setting.learner = setting.start()
    assert setting.learner.step()
    assert setting.learner.checkpoints.patience(0.0) > 3 * 3.0


def test_how_long_a_save_takes_is_noted(setting, monkeypatch):
    whole = setting.learner.checkpoints.save
    monkeypatch.setattr(setting.learner.checkpoints, "save", lambda *given: (time.sleep(0.5), whole(*given))[1])
    assert setting.learner.checkpoint()
    assert setting.learner.checkpoints.patience(0.0) > 3 * 0.5


def test_an_update_gets_its_windows_importance_and_beta_of_the_environments_steps(setting, monkeypatch):
    learner, drawn, handed = setting.learner, [], []
    learner.update.config = dataclasses.replace(learner.update.config, curiosity=0.5, curiosity_steps=2_000)
    sample, update = setting.server.sample, type(learner._runner).__call__

    def draws(*args):
        drawn.append(sample(*args))
        return drawn[-1]

    def updates(self, raw, importance, beta, number):
        handed.append((importance.clone().numpy(), beta))
        return update(self, raw, importance, beta, number)

    monkeypatch.setattr(setting.server, "sample", draws)
    monkeypatch.setattr(type(learner._runner), "__call__", updates)
    for _ in range(4):
        setting.update()
    for (importance, beta), batch in zip(handed, drawn, strict=True):
        np.testing.assert_allclose(importance, (batch.weights / batch.weights.min()) ** -0.4, rtol=1e-5)
        assert beta == pytest.approx(0.5 * (1.0 - batch.env_steps / 2_000))
    assert handed[-1][0].min() < 0.99
    assert 0.0 < handed[-1][1] < handed[0][1] < 0.5


def test_every_broadcast_has_the_statistics_of_its_time(setting):
    for _ in range(3):
        setting.feed(60)
        while setting.learner.step():
            pass
        mean = setting.learner.agent.normalizer.mean.clone()
        setting.feed(60)
        setting.learner.publish()
        weights, statistics = safetensors.torch.load(setting.bus.weights()[1]), setting.server.statistics()
        told = torch.from_numpy(statistics.total / statistics.count).float()
        torch.testing.assert_close(weights["normalizer.mean"], told)
        assert not torch.equal(told, mean)


def test_padding_is_zero_in_what_is_learnt_from(setting, monkeypatch):
    """Whatever an actor has sent there."""
    rows, learnt = random_rows(60), []
    rows["observation"][~observation_valid(rows)] = 7.0
    rows["reward"][~step_valid(rows)] = 7.0
    rows["new_steps"] = rows["new_observations"] = rows["last"] - SPEC.burn_in
    update = type(setting.learner._runner).__call__

    def updates(self, raw, *rest):
        learnt.append(raw.numpy().view(SPEC.dtype).reshape(-1).copy())
        return update(self, raw, *rest)

    monkeypatch.setattr(type(setting.learner._runner), "__call__", updates)
    setting.bus.append(0, EntryId(1, 1), encode_windows(rows, SPEC))
    while setting.server.step():
        pass
    assert setting.learner.step()
    (seen,) = learnt
    assert not seen["observation"][~observation_valid(seen)].any()
    assert not seen["reward"][~step_valid(seen)].any()
