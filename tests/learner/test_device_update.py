"""The update that reads the same memory every time; what a CUDA graph asks of it, as far as a CPU can say.

A CUDA stream, event and graph can't be had here: they are mocks with the signatures of the real ones.
"""

import dataclasses
from contextlib import nullcontext
from types import SimpleNamespace
from unittest.mock import MagicMock, call, create_autospec

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.common.window import WindowSpec
from rmc.learner.batch import clear_padding, view_batch
from rmc.learner.config import UpdateConfig
from rmc.learner.device_update import WARM_UP, CopiesAhead, CudaGraph, DeviceUpdate, GraphPlace, HostCopy
from rmc.learner.update import JointUpdate
from rmc.learner.update_order import make_update
from tests.learner.agents import ROBUST
from tests.learner.rows import LONG, SPEC, random_rows

BATCH = 8
NORMED = dataclasses.replace(ROBUST, critic_batch_norm=True)
IMPUTING = dataclasses.replace(ROBUST, hidden=SPEC.state - SPEC.obs_dim, impute_missing=True)


def make(order: str = "joint", device: str = "cpu", bf16: bool = False, config: AgentConfig = ROBUST) -> JointUpdate:
    """In that order, or "apart": its halves may go at once."""
    torch.manual_seed(0)
    update = UpdateConfig(curiosity=0.1, curiosity_scale="std", n_step=2, scheme=3)
    if order == "apart":
        update = dataclasses.replace(update, policy_delay=2)
    else:
        update = dataclasses.replace(update, update_order=order, latent_target="ema", target_memory="ema", scheme=1)  # type: ignore[arg-type]
    agent = Agent(SPEC.obs_dim, SPEC.action_dim, config).to(device)
    return make_update(agent, update, 3, bf16)


def host_batch(
    seed: int, pinned: bool = False, missing: bool = True, spec: WindowSpec = SPEC, longest: int | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    rows = random_rows(BATCH, seed, spec, longest)
    rows["missing"] *= missing
    clear_padding(rows, spec)
    raw = torch.from_numpy(rows.view("u1").reshape(BATCH, -1))
    importance = torch.from_numpy(np.random.default_rng(seed).uniform(0.5, 1.0, BATCH).astype(np.float32))
    return (raw.pin_memory(), importance.pin_memory()) if pinned else (raw, importance)


@pytest.mark.parametrize("config", [ROBUST, NORMED], ids=["robust", "normed"])
@pytest.mark.parametrize("order", ["joint", "alternate"])
def test_it_is_the_same_update(order, config):
    plain, update = make(order, config=config), make(order, config=config)
    static = DeviceUpdate(update, SPEC, BATCH)
    for step in range(20):
        raw, importance = host_batch(step)
        expected = plain(view_batch(raw, importance, SPEC), torch.tensor(0.1 * step))
        (result,) = static(raw, importance, 0.1 * step, step + 1)
        assert torch.equal(result.priorities, expected.priorities)
        assert all(torch.equal(result.metrics[name], value) for name, value in expected.metrics.items())
    assert all(map(torch.equal, update.agent.state_dict().values(), plain.agent.state_dict().values()))


@pytest.mark.parametrize("order", ["joint", "alternate"])
def test_a_cut_batch_teaches_what_the_whole_one_does(order):
    """To rounding: sums over other lengths are taken in another order. Noise and beta are the same."""
    whole, update = make(order), make(order)
    cut, lengths = DeviceUpdate(update, LONG, BATCH), [3, 16, 17, 60, 30, 3, 48, 25]
    for number, longest in enumerate(lengths, 1):
        raw, importance = host_batch(number, spec=LONG, longest=longest)
        expected = whole(view_batch(raw, importance, LONG), torch.tensor(0.1))
        (result,) = cut(raw, importance, 0.1, number)
        steps = result.hidden.shape[1] - 1
        assert steps == (60 if number == 1 else {3: 16, 16: 16, 17: 24, 60: 60, 30: 32, 48: 48, 25: 32}[longest])
        assert torch.equal(result.observed, expected.observed[:, : steps + 1])
        assert not expected.observed[:, steps + 1 :].any()
        torch.testing.assert_close(result.priorities, expected.priorities, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(result.metrics, expected.metrics, rtol=1e-4, atol=1e-5)
        real = result.observed.unsqueeze(-1)
        torch.testing.assert_close(result.hidden * real, expected.hidden[:, : steps + 1] * real, rtol=1e-4, atol=1e-5)
    assert torch.equal(update.generator.get_state(), whole.generator.get_state())
    torch.testing.assert_close(update.agent.state_dict(), whole.agent.state_dict(), rtol=1e-4, atol=1e-5)


class OnDevice(TorchDispatchMode):
    """Fails where an operation reads or makes a tensor on the host."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for x in tree_leaves((args, kwargs, result)):
            assert not isinstance(x, torch.Tensor) or x.device.type == "meta", func
        return result


@pytest.mark.parametrize("config", [ROBUST, NORMED, IMPUTING], ids=["robust", "normed", "imputing"])
@pytest.mark.parametrize("order", ["joint", "alternate"])
def test_nothing_in_an_update_waits_for_the_host(order, config, monkeypatch):
    """On the device "meta", which has no values: whatever asks for one fails."""
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # meta has none
    update = make(order, config=config)
    for module in (update.agent, update.target_critic, update.ema_memory):
        if module is not None:
            module.to("meta")
    update.curiosity_variance = update.curiosity_variance.to("meta")
    moved = SimpleNamespace(param_groups=[{"params": list(update.agent.parameters())}], step=lambda: None)
    update.optimizers = [moved] * len(update.optimizers)  # torch's Adam knows no "meta"
    raw = torch.empty(BATCH, SPEC.dtype.itemsize, dtype=torch.uint8, device="meta")
    importance, beta = torch.empty(BATCH, device="meta"), torch.empty((), device="meta")
    view_batch(raw, importance, SPEC)  # makes its constants
    with OnDevice():
        update(view_batch(raw, importance, SPEC), beta)


def test_the_check_sees_what_waits():
    with OnDevice(), pytest.raises(AssertionError):
        torch.zeros(2)
    with OnDevice(), pytest.raises(RuntimeError):
        torch.empty(2, device="meta").sum().item()


@pytest.fixture
def cuda(monkeypatch):
    """Streams, events and graphs that only remember what they were asked."""
    calls = MagicMock()
    for name in ("Stream", "Event", "CUDAGraph"):
        double = create_autospec(getattr(torch.cuda, name), instance=True, spec_set=name != "CUDAGraph")
        calls.attach_mock(double, name)
        monkeypatch.setattr(torch.cuda, name, lambda *_, double=double: double)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda _: calls.current)
    monkeypatch.setattr(torch.cuda, "stream", lambda _: nullcontext())
    monkeypatch.setattr(
        torch.cuda, "graph", lambda graph, pool, stream: nullcontext(calls.recording(graph, pool, stream))
    )
    return calls


def test_a_graph_is_recorded_once_after_the_warm_up_and_replayed(cuda):
    cuda.CUDAGraph.register_generator_state = MagicMock()
    work, generator = MagicMock(return_value="result"), torch.Generator()
    graph = CudaGraph(work, generator, GraphPlace(cuda.Stream, (0, 1)))
    for _ in range(WARM_UP):
        assert graph() == "result"
    cuda.recording.assert_not_called()
    for _ in range(3):
        assert graph() == "result"
    assert work.call_count == WARM_UP + 1
    cuda.recording.assert_called_once_with(cuda.CUDAGraph, (0, 1), cuda.Stream)
    cuda.CUDAGraph.register_generator_state.assert_called_once_with(generator)
    assert cuda.CUDAGraph.replay.call_count == 3


def test_each_plan_has_a_graph_of_its_own(monkeypatch):
    """Here the graphs are doubles that run as they are; a GPU's test is below."""
    made = []

    class Double:
        def __init__(self, work, generator, place):
            made.append(work)
            self._work = work

        def __call__(self):
            return self._work()

    monkeypatch.setattr("rmc.learner.device_update.CudaGraph", Double)
    plain, update = make(config=IMPUTING), make(config=IMPUTING)
    apart = DeviceUpdate(update, SPEC, BATCH)
    apart._work, apart._graphs, apart._place = apart._replay, {}, None
    for number in range(1, 20):
        raw, importance = host_batch(number, missing=number == 12)
        expected = plain(view_batch(raw, importance, SPEC, plain.plan(raw, SPEC, number)), torch.tensor(0.1))
        (result,) = apart(raw, importance, 0.1, number)
        assert torch.equal(result.priorities, expected.priorities)
    assert [(work.func.__name__, *work.args[0][1:]) for work in made] == [
        ("_once", False, False, True),
        ("_once", False, True, True),
        ("_once", True, True, True),
    ]
    assert all(map(torch.equal, update.agent.state_dict().values(), plain.agent.state_dict().values()))


def noted(work, note):
    """What it does, once ``note`` was called."""

    def noting(*given):
        note()
        return work(*given)

    return noting


def test_halves_at_once_are_the_update(cuda, monkeypatch):
    """On a GPU in two streams, which meet before the result is read."""
    plain, update = (make("apart", config=IMPUTING) for _ in range(2))
    for name in ("model_pass", "actor_critic_pass", "step"):
        monkeypatch.setattr(update, name, noted(getattr(update, name), getattr(cuda, name)))
    one_by_one, at_once = (DeviceUpdate(one, SPEC, BATCH) for one in (plain, update))
    at_once._beside, at_once._work = cuda.beside, at_once._halves_at_once
    for number in range(1, 6):
        raw, importance = host_batch(number, missing=number > 3)
        (expected,) = one_by_one(raw, importance, 0.1, number)
        cuda.reset_mock()
        (result,) = at_once(raw, importance, 0.1, number)
        assert torch.equal(result.priorities, expected.priorities)
        torch.testing.assert_close(result.metrics, expected.metrics)
        assert cuda.mock_calls == [
            call.model_pass(), call.beside.wait_stream(cuda.current), call.actor_critic_pass(), call.step(),
            call.step(), call.current.wait_stream(cuda.beside),
        ]  # fmt: skip
    assert all(map(torch.equal, update.agent.state_dict().values(), plain.agent.state_dict().values()))


def test_a_copy_waits_until_the_last_was_taken_and_is_waited_for(cuda):
    place = torch.zeros(3)
    copies = CopiesAhead([place])
    for value in (1.0, 2.0):
        cuda.reset_mock()
        copies([torch.full((3,), value)])
        assert place.tolist() == [value] * 3
        assert cuda.mock_calls == [
            call.Stream.wait_event(cuda.Event),
            call.current.wait_stream(cuda.Stream),
            call.Event.record(cuda.current),
        ]


def test_a_state_of_another_device_resumes():
    """A CPU's generator has another state than a GPU's; Adam's step is captured only on a GPU."""
    saved = make()
    saved(view_batch(*host_batch(0), SPEC), torch.tensor(0.0))
    state = saved.state_dict()
    state["generator"] = torch.arange(16, dtype=torch.uint8)
    for optimizer in state["optimizers"]:
        for group in optimizer["param_groups"]:
            group["capturable"] = True
    update = make()
    update.load_state_dict(state)
    assert not any(group["capturable"] for optimizer in update.optimizers for group in optimizer.param_groups)
    first = torch.randn(3, generator=update.generator)
    update.load_state_dict(state)
    assert torch.equal(torch.randn(3, generator=update.generator), first)
    update(view_batch(*host_batch(1), SPEC), torch.tensor(0.0))


def test_a_tensor_on_the_host_is_there_at_once():
    assert HostCopy(torch.arange(3)).wait().tolist() == [0, 1, 2]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("bf16", [False, True], ids=["fp32", "bf16"])
@pytest.mark.parametrize("order", ["joint", "alternate", "apart"])
def test_a_graph_trains_as_the_updates_one_by_one(order, bf16):
    """100 updates, each plan several times; equal losses to 1e-3."""
    config = dataclasses.replace(IMPUTING, critic_batch_norm=order == "apart")
    plain, update = make(order, "cuda", bf16, config), make(order, "cuda", bf16, config)
    static = DeviceUpdate(update, LONG, BATCH)
    for number in range(1, 101):
        raw, importance = host_batch(number, pinned=True, missing=number > 50, spec=LONG, longest=(20, 60)[number % 2])
        plan = plain.plan(raw, LONG, number)
        expected = plain(view_batch(raw.cuda(), importance.cuda(), LONG, plan), torch.tensor(0.1, device="cuda"))
        (result,) = static(raw, importance, 0.1, number)
        torch.testing.assert_close(result.metrics, expected.metrics, rtol=1e-3, atol=1e-3)
        priorities = HostCopy(result.priorities).wait()
        torch.testing.assert_close(priorities, expected.priorities.cpu(), rtol=1e-3, atol=1e-3)
    assert {graph._work.func.__name__ for graph in static._graphs.values()} == {
        "_halves_at_once" if order == "apart" else "_once"
    }
