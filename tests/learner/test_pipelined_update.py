"""An update whose halves run in two processes is the update, bit for bit; its process ends with it."""

import copy
import errno
import os
import re
import signal
from dataclasses import replace

import pytest
import torch

from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.common.errors import RmcError
from rmc.common.window import WindowSpec
from rmc.deploy.run.presets import robust
from rmc.learner.config import UpdateConfig
from rmc.learner.device_update import DeviceUpdate
from rmc.learner.learner_checkpoint import STATE, LearnerProgress, pack, take_up
from rmc.learner.pipelined_update import PipelinedUpdate
from rmc.learner.update import JointUpdate
from rmc.learner.update_order import make_update
from tests.learner.rows import BY_NUMBER, LONG, SPEC
from tests.learner.test_device_update import BATCH, host_batch

ROBUST = UpdateConfig(scheme=3, curiosity=0.1, curiosity_scale="std", policy_ema_updates=100, policy_delay=2)
RAW = UpdateConfig(scheme=3)
PROGRESS = LearnerProgress(1, 1, 1)
AGENTS = {
    "robust": replace(robust("Ant-v5").agent, hidden=SPEC.state - SPEC.obs_dim, embedding=7, heads=(10, 9)),
    "h alone": AgentConfig(hidden=SPEC.state, embedding=7, heads=(10, 9), head_input="hidden"),
    "embedding beside": AgentConfig(
        hidden=SPEC.state, embedding=7, heads=(10, 9), head_input="hidden+observation", grounding=False
    ),
}


pytestmark = pytest.mark.usefixtures("one_thread")


def make(agent: str, bf16: bool, spec: WindowSpec = SPEC) -> JointUpdate:
    torch.manual_seed(0)
    network = Agent(spec.obs_dim, spec.action_dim, AGENTS[agent], spec.missing, spec.privileged)
    return make_update(network, ROBUST, 3, bf16)


@pytest.mark.parametrize("bf16", [False, True])
@pytest.mark.parametrize("agent", AGENTS)
@pytest.mark.parametrize("spec", [SPEC, BY_NUMBER, LONG], ids=["by frame", "by number", "cut windows"])
def test_it_is_the_same_update(agent, bf16, spec):
    plain, update = make(agent, bf16, spec), make(agent, bf16, spec)
    in_turn, apart = DeviceUpdate(plain, spec, BATCH), PipelinedUpdate(update, spec, BATCH)
    expected, actual = [], []
    for step in range(1, 25):
        number = 200 + step  # where an average is over some
        longest = (3, 20, 60, 40)[step % 4] if spec is LONG else None
        # what imputes is trained at some updates, then at all
        raw, importance = host_batch(step, missing=step > 12, spec=spec, longest=longest)
        for updated, results in ((in_turn, expected), (apart, actual)):
            results += copy.deepcopy(updated(raw, importance, 0.1 * step, number))
        if step % 9 == 0:  # as before weights are read
            actual += copy.deepcopy(apart.drain())
            torch.testing.assert_close(update.agent.state_dict(), plain.agent.state_dict(), rtol=0, atol=0)
    actual += copy.deepcopy(apart.drain())
    apart.close()
    assert len(actual) == len(expected) == 24
    for one, other in zip(actual, expected, strict=True):
        assert torch.equal(one.priorities, other.priorities)
        assert torch.equal(one.hidden, other.hidden)
        norm, of_both = one.metrics.pop("grad_norm"), other.metrics.pop("grad_norm")
        assert norm == pytest.approx(float(of_both), rel=1e-5)  # of the halves' norms
        torch.testing.assert_close(one.metrics, other.metrics, rtol=0, atol=0)
    torch.testing.assert_close(update.state_dict(), plain.state_dict(), rtol=0, atol=0)


def test_it_goes_on_from_a_checkpoint_of_the_other_kind():
    plain = make("robust", False)
    first = DeviceUpdate(plain, SPEC, BATCH)
    for step in range(1, 6):
        first(*host_batch(step), 0.1, step)
    update = make("robust", False)
    update.load_state_dict(copy.deepcopy(plain.state_dict()))
    apart = PipelinedUpdate(update, SPEC, BATCH)
    for step in range(6, 12):
        first(*host_batch(step), 0.1, step)
        apart(*host_batch(step), 0.1, step)
    apart.drain()
    apart.close()
    torch.testing.assert_close(update.state_dict(), plain.state_dict(), rtol=0, atol=0)


def test_a_checkpoint_holds_what_the_plain_updates_does():
    """Not the batches that lie in the same memory, before a resume and after it."""
    agents = [Agent(SPEC.obs_dim, SPEC.action_dim, AGENTS["robust"]) for _ in range(2)]
    update, plain = (make_update(agent, RAW, 3) for agent in agents)
    apart, in_turn = PipelinedUpdate(update, SPEC, BATCH), DeviceUpdate(plain, SPEC, BATCH)
    for one in (apart, in_turn):
        one(*host_batch(1), 0.1, 1)
        one.drain()
    apart.close()
    first, expected = (pack(one.state_dict(), b"", PROGRESS) for one in (update, plain))
    take_up(first, plain, torch.device("cpu"))
    again = pack(plain.state_dict(), b"", PROGRESS)
    assert len(first[STATE]) == pytest.approx(len(expected[STATE]), rel=0.01)
    assert len(again[STATE]) == pytest.approx(len(expected[STATE]), rel=0.01)


@pytest.mark.parametrize(
    ("number", "how"),
    [(signal.SIGKILL, "was killed by signal 9; is memory short?"), (signal.SIGUSR1, "was killed by signal 10")],
)
def test_a_process_that_is_killed_is_told(number, how):
    apart = PipelinedUpdate(make("robust", False), SPEC, BATCH)
    apart(*host_batch(1), 0.1, 1)
    os.kill(apart._child, number)
    for _ in range(2):  # as one that saves at its end
        with pytest.raises(RmcError, match=f"^the process of memory and world model {re.escape(how)}$"):
            [apart(*host_batch(step), 0.1, step) for step in range(2, 5)]
    apart.close()


def test_a_process_that_fails_ends_where_it_cannot_even_print_why(monkeypatch):
    """Its sys.stderr is pytest's, which it has closed."""
    apart = PipelinedUpdate(make("robust", False), SPEC, BATCH)
    monkeypatch.setattr(apart, "_model_half", lambda *_: 1 / 0)
    with pytest.raises(RmcError, match=r"memory and world model has ended; the lines above say why$"):
        [apart(*host_batch(step), 0.1, step) for step in range(1, 5)]
    apart.close()


def test_where_no_process_can_be_made_there_is_none_to_end(monkeypatch):
    def full():
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", full)
    apart, before = PipelinedUpdate(make("robust", False), SPEC, BATCH), len(os.listdir("/proc/self/fd"))
    with pytest.raises(BlockingIOError):
        apart(*host_batch(1), 0.1, 1)
    assert len(os.listdir("/proc/self/fd")) == before
    apart.close()


def test_both_halves_take_the_threads_that_are_set(tmp_path, monkeypatch):
    def note(number: int) -> None:
        with (tmp_path / str(os.getpid())).open("a") as file:
            file.write(f"{number} ")

    monkeypatch.setattr("rmc.learner.pipelined_update.torch.set_num_threads", note)
    apart = PipelinedUpdate(make("robust", False), SPEC, BATCH)
    apart.use_threads(4)  # before there is another process: nothing may run on several
    assert not list(tmp_path.iterdir())
    apart(*host_batch(1), 0.1, 1)
    apart.use_threads(2)
    apart(*host_batch(2), 0.1, 2)
    apart.drain()
    apart.close()
    ours, theirs = ((tmp_path / str(process)).read_text() for process in (os.getpid(), apart._child))
    assert (ours, theirs) == ("4 2 ", "4 2 ")


@pytest.mark.parametrize(
    "other",
    [
        {"scheme": 1},
        {"update_order": "alternate"},
        {"clip_norm": 1.0},
        {"target_memory": "ema"},
        {"latent_target": "ema"},
    ],
)
def test_what_flows_back_stays_in_one_process(other):
    assert ROBUST.halves_are_apart()
    assert not UpdateConfig(**{"scheme": 3, **other}).halves_are_apart()  # type: ignore[arg-type]
