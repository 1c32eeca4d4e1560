"""The joint update: gradients reach what scheme 1 says, padding reaches nothing, state comes back bit for bit."""

import copy
import dataclasses
import io

import pytest
import torch

from rmc.common.agent import Agent, Normalizer
from rmc.common.agent_config import AgentConfig
from rmc.learner import losses
from rmc.learner.batch import clear_padding, longest_steps, view_batch
from rmc.learner.config import UpdateConfig
from rmc.learner.learner_metrics import METRICS_UPDATES
from rmc.learner.unroll import unroll
from rmc.learner.update import IMPUTER_UPDATES, TRAINS_MEMORY, JointUpdate, UpdateResult
from rmc.learner.update_order import make_update
from tests.learner.agents import PAPER, ROBUST
from tests.learner.rows import SPEC, observation_valid, random_rows, spoil_padding, to_batch

BETA = torch.tensor(0.5)


def make(agent: AgentConfig, bf16: bool = False, **options: object) -> JointUpdate:
    torch.manual_seed(0)
    network = Agent(SPEC.obs_dim, SPEC.action_dim, agent)
    network.normalizer.freeze(torch.tensor(10), torch.ones(SPEC.obs_dim), torch.full((SPEC.obs_dim,), 20.0))
    return make_update(network, UpdateConfig(curiosity=0.5, **options), 3, bf16)  # type: ignore[arg-type]


def silence_all_but(keep: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in {"model_loss", "q_loss", "policy_loss", "temperature_loss", "grounding_loss"} - {keep}:
        original = getattr(losses, name)
        monkeypatch.setattr(losses, name, lambda *args, original=original: 0.0 * original(*args))


def gradients(update: JointUpdate, keep: str, monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Names of parameters that one loss alone gives a gradient."""
    silence_all_but(keep, monkeypatch)
    update(to_batch(random_rows(8)), BETA)
    return {name for name, p in update.agent.named_parameters() if p.grad is not None and p.grad.abs().sum() > 0}


def part(update: JointUpdate, *prefixes: str) -> set[str]:
    return {name for name, _ in update.agent.named_parameters() if name.startswith(prefixes)}


@pytest.mark.parametrize("agent", [ROBUST, PAPER], ids=["robust", "paper"])
@pytest.mark.parametrize("scheme", TRAINS_MEMORY)
@pytest.mark.parametrize("order", ["joint", "alternate"])
@pytest.mark.parametrize(
    ("loss", "by", "head"),
    [
        ("model_loss", "model", "world_model."),
        ("q_loss", "value", "critic."),
        ("policy_loss", "policy", "policy."),
        ("temperature_loss", None, "log_alpha"),
    ],
)
def test_a_schemes_gradients_reach_exactly(agent, scheme, order, loss, by, head, monkeypatch):
    table = {1: "MV", 2: "V", 3: "M", 4: "MVP", 5: "MP", 6: "VP"}  # the paper's table 1
    trains = by is not None and by[0].upper() in table[scheme]
    update = make(agent, scheme=scheme)
    if order == "joint":
        assert gradients(update, loss, monkeypatch) == part(update, head, *["memory."] * trains)
        return
    moving = make(agent, scheme=scheme, update_order=order)
    before = copy.deepcopy(moving.agent.state_dict())
    silence_all_but(loss, monkeypatch)
    moving(to_batch(random_rows(8)), BETA)
    moved = {name for name, p in moving.agent.named_parameters() if not torch.equal(p, before[name])}
    assert moved == part(moving, head, *["memory."] * trains)


def test_grounding_reaches_memory_and_world_model(monkeypatch):
    update = make(ROBUST)
    assert gradients(update, "grounding_loss", monkeypatch) == part(update, "memory.", "world_model.")


def test_what_fills_blanks_trains_itself_alone():
    config = dataclasses.replace(ROBUST, impute_missing=True)
    spec, update = dataclasses.replace(SPEC, state=config.state_size(SPEC.obs_dim)), make(config, scheme=4)
    parts, *_ = update.forward(to_batch(random_rows(8, spec=spec), spec), BETA)
    named = dict(update.agent.named_parameters())
    for loss in parts:
        grads = torch.autograd.grad(parts[loss], list(named.values()), retain_graph=True, allow_unused=True)
        reached = {name for name, grad in zip(named, grads, strict=True) if grad is not None and grad.abs().sum() > 0}
        assert reached
        own = part(update, "next_frame.")
        assert reached == own if loss == "fill_loss" else not reached & own, loss


def test_garbage_in_padding_changes_nothing():
    rows = random_rows(12)
    dirty = rows.copy()
    spoil_padding(dirty)
    clean_update, dirty_update = make(ROBUST, latent_target="ema"), make(ROBUST, latent_target="ema")
    clean, dirtied = clean_update(to_batch(rows), BETA), dirty_update(to_batch(dirty), BETA)
    assert torch.equal(clean.priorities, dirtied.priorities)
    assert torch.equal(clean.observed, torch.from_numpy(observation_valid(rows)[:, SPEC.burn_in :]))
    assert torch.equal(clean.hidden[clean.observed], dirtied.hidden[dirtied.observed])
    for name, value in clean.metrics.items():
        assert torch.equal(value, dirtied.metrics[name]), name
    torch.testing.assert_close(clean_update.agent.state_dict(), dirty_update.agent.state_dict(), rtol=0, atol=0)


def test_padded_burn_in_starts_from_the_stored_state():
    """A window whose burn-in is padding gives the same h as the trained part alone from its stored state."""
    rows = random_rows(6)
    rows["first"] = SPEC.burn_in
    rows["observation"][:, : SPEC.burn_in] = 0.0
    batch, update = to_batch(rows), make(PAPER)
    hidden = unroll(update.agent.memory, batch.observation, batch).hidden
    n = SPEC.burn_in
    o, missing, previous = batch.observation[:, n:], batch.missing[:, n:], batch.prev_action[:, n:]
    alone = update.agent.memory(o, missing, previous, batch.state).hidden
    assert torch.equal(hidden, alone)


def test_burn_in_gets_no_gradient():
    rows = random_rows(6)
    rows["first"] = 0
    batch, update = to_batch(rows), make(PAPER)
    o = batch.observation.clone().requires_grad_()
    unroll(update.agent.memory, o, batch).hidden.sum().backward()
    assert o.grad is not None
    assert not o.grad[:, : SPEC.burn_in].any()
    assert o.grad[:, SPEC.burn_in :].any()


@pytest.mark.parametrize("norm", ["l1", "l2"])
def test_a_model_that_predicts_no_change_leaves_all_of_it_unexplained(norm):
    update = make(PAPER, model_norm=norm)
    with torch.no_grad():
        for value in update.agent.world_model.net[-1].parameters():
            value.zero_()
    assert update(to_batch(random_rows(8)), BETA).metrics["model_unexplained"].item() == pytest.approx(1.0, rel=1e-4)


def test_error_by_observation_dimension():
    update, rows = make(ROBUST), random_rows(8)
    with torch.no_grad():
        for value in update.agent.world_model.net[-1].parameters():
            value.zero_()
    rows["observation"][..., 1] = 0.7  # never changes, wherever it is seen
    unexplained = update(to_batch(rows), BETA).observation_unexplained
    torch.testing.assert_close(unexplained, torch.tensor([1.0, 0.0, 1.0]))
    assert make(PAPER)(to_batch(rows), BETA).observation_unexplained.shape == (0,)


def test_targets_follow_by_polyak_alone():
    update = make(PAPER, polyak=0.9, target_memory="ema")
    before = copy.deepcopy(update.target_critic.state_dict())
    update(to_batch(random_rows(8)), BETA)
    for name, value in update.target_critic.state_dict().items():
        online = update.agent.critic.state_dict()[name]
        torch.testing.assert_close(value, 0.9 * before[name] + 0.1 * online)
    targets = [*update.target_critic.parameters(), *update.ema_memory.parameters()]
    assert all(p.grad is None for p in targets)


def test_the_policys_average_is_over_the_last_tenth_and_then_over_so_many():
    """As a plain loop has it. What does not act has none."""
    update = make(dataclasses.replace(ROBUST, impute_missing=True), policy_ema_updates=40)
    names = {name for name, _ in update.agent.named_parameters() if name.startswith(("memory", "policy", "next_frame"))}
    average = update.average.state_dict()
    assert set(average) == names
    expected = {name: value.double() for name, value in average.items()}
    for updates in range(10, 1_001, 10):
        with torch.no_grad():
            for value in update.agent.parameters():
                value.add_(torch.randn_like(value))
        update.average.update(updates)
        share = 1.0 if updates <= 100 else max(0.25, 100 / updates)  # ten updates of those it is over
        acting = dict(update.agent.named_parameters())
        expected = {name: (1 - share) * mean + share * acting[name].double() for name, mean in expected.items()}
        for name, mean in expected.items():
            torch.testing.assert_close(average[name].double(), mean, rtol=0, atol=1e-5)
    for name, value in update.average.policy_weights().items():
        if name in names:
            assert torch.equal(value, average[name])
            assert not torch.equal(value, acting[name])
        else:
            assert torch.equal(value, update.agent.state_dict()[name])


@pytest.mark.parametrize("scale", [1e-4, 1.0, 100.0])
def test_curiosity_is_in_units_of_its_deviation_from_the_first_update_on(scale):
    update, i = make(ROBUST, curiosity_scale="std"), scale * torch.randn(32, 15)
    m = torch.ones_like(i)
    torch.testing.assert_close(update._scaled(i, m)[0].std(correction=0), torch.tensor(1.0))


def test_state_comes_back_bit_for_bit():
    straight, stopped = make(ROBUST, curiosity_scale="std"), make(ROBUST, curiosity_scale="std")
    for u in (straight, stopped):
        for seed in range(3):
            u(to_batch(random_rows(8, seed)), BETA)
    file = io.BytesIO()
    torch.save(stopped.state_dict(), file)
    file.seek(0)
    torch.manual_seed(99)
    resumed = make_update(Agent(SPEC.obs_dim, SPEC.action_dim, ROBUST), straight.config, seed=1234)
    resumed.load_state_dict(torch.load(file, weights_only=True))
    for seed in range(3, 6):
        a, b = (u(to_batch(random_rows(8, seed)), BETA) for u in (straight, resumed))
        assert torch.equal(a.priorities, b.priorities)
    torch.testing.assert_close(straight.agent.state_dict(), resumed.agent.state_dict(), rtol=0, atol=0)


def test_beta_decays_to_zero():
    config = UpdateConfig(curiosity=0.5, curiosity_steps=100)
    assert [config.beta(n) for n in (0, 50, 100, 1000)] == [0.5, 0.25, 0.0, 0.0]


def test_values_and_policy_are_not_rounded_to_bf16():
    agent, action = make(ROBUST).agent, torch.rand(4, 5, SPEC.action_dim)
    features = torch.randn(4, 5, ROBUST.hidden + SPEC.obs_dim)
    with torch.autocast("cpu", torch.bfloat16):
        outputs = [agent.critic(features, action), *agent.policy(features)]
    for output in outputs:
        assert output.dtype == torch.float32
        assert not torch.equal(output, output.bfloat16().float())


def test_bf16_stays_near_fp32():
    plain, half = (make(ROBUST, bf16, target_memory="ema") for bf16 in (False, True))
    a, b = (u(to_batch(random_rows(32)), BETA) for u in (plain, half))
    for name in ("model_loss", "q_loss", "policy_loss", "grounding_loss"):
        assert b.metrics[name].item() == pytest.approx(a.metrics[name].item(), rel=0.05, abs=0.02), name
    for (name, p), q in zip(plain.agent.named_parameters(), half.agent.parameters(), strict=True):
        assert p.grad is not None
        assert q.grad is not None
        assert (p.grad - q.grad).norm() <= 0.15 * p.grad.norm() + 1e-4, name


@pytest.mark.parametrize("order", ["joint", "alternate"])
def test_a_checkpoint_does_not_bring_its_step_sizes_along(order: str) -> None:
    before, rates = make(ROBUST, update_order=order), {"learning_rate": 1e-5, "alpha_learning_rate": 2e-5}
    before(to_batch(random_rows(8)), BETA)
    after = make(ROBUST, update_order=order, memory_learning_scale=0.5, **rates)
    after.load_state_dict(before.state_dict())
    for optimizer in after.optimizers:
        for group in optimizer.param_groups:
            owner = group["params"][0]
            in_memory = any(owner is value for value in after.agent.memory.parameters())
            assert group["lr"] == (2e-5 if owner is after.agent.log_alpha else 5e-6 if in_memory else 1e-5)
    assert all(optimizer.state for optimizer in after.optimizers)  # their moments go on
    moved = [value.detach().clone() for value in after.agent.critic.parameters()]
    after(to_batch(random_rows(8)), BETA)
    steps = [(new - old).abs().max() for new, old in zip(after.agent.critic.parameters(), moved, strict=True)]
    assert 0 < max(steps) < 2e-5


IMPUTING = dataclasses.replace(ROBUST, impute_missing=True)
WITH_FRAMES = dataclasses.replace(SPEC, state=IMPUTING.state_size(SPEC.obs_dim))


def update_of(update: JointUpdate, number: int, is_missing: bool) -> UpdateResult:
    """Update ``number``, planned, of a batch in which frames are missing or none is."""
    rows = random_rows(8, number, WITH_FRAMES)
    rows["missing"] *= is_missing
    clear_padding(rows, WITH_FRAMES)
    raw = torch.from_numpy(rows.view("u1").reshape(8, -1))
    plan = update.plan(raw, WITH_FRAMES, number)
    assert plan.imputes == is_missing
    return update(view_batch(raw, torch.ones(8), WITH_FRAMES, plan), BETA)


def moves_of_the_imputer(update: JointUpdate, updates: int, missing_from: int, begin: int = 1) -> list[int]:
    """The updates at which it moves; frames are missing in batches from ``missing_from`` on, for one batch."""
    moves, weight = [], update.agent.next_frame.net[0].weight  # type: ignore[union-attr]
    for number in range(begin, begin + updates):
        before = weight.detach().clone()
        update_of(update, number, number == missing_from)
        moves += [number] if not torch.equal(weight, before) else []
    return moves


def test_what_imputes_is_trained_seldom_until_a_frame_is_missing():
    update = make(IMPUTING)
    assert moves_of_the_imputer(update, 30, missing_from=25) == [10, 20, *range(25, 31)]
    in_turn = make(IMPUTING, update_order="alternate")
    assert moves_of_the_imputer(in_turn, 14, missing_from=12) == [10, 12, 13, 14]
    assert METRICS_UPDATES % IMPUTER_UPDATES == 0  # what is looked at has its loss


def test_its_turns_go_on_from_a_checkpoint():
    before, after = make(IMPUTING), make(IMPUTING)
    assert moves_of_the_imputer(before, 5, missing_from=99) == []
    after.load_state_dict(before.state_dict())
    assert moves_of_the_imputer(after, 4, missing_from=8, begin=6) == [8, 9]
    after.load_state_dict(after.state_dict())
    assert moves_of_the_imputer(after, 2, missing_from=99, begin=11) == [11, 12]
    assert update_of(after, 13, False).metrics["fill_loss"] > 0


def test_an_older_checkpoint_says_nothing_of_missing_frames():
    update = make(IMPUTING)
    older = {name: value for name, value in update.state_dict().items() if name != "was_missing"}
    update.load_state_dict(older)
    assert moves_of_the_imputer(update, 2, missing_from=99, begin=2) == []


@pytest.mark.parametrize("order", ["joint", "alternate"])
def test_the_policy_waits_for_its_turn_and_nothing_else_does(order):
    update = make(ROBUST, update_order=order, scheme=3, policy_delay=3)
    raw = torch.from_numpy(random_rows(8).view("u1").reshape(8, -1))
    moves, said = [], []
    for number in range(1, 7):
        before = copy.deepcopy(update.agent.state_dict())
        plan = update.plan(raw, SPEC, number)
        updated = update(view_batch(raw, torch.ones(8), SPEC, plan), BETA)
        moved = {name for name, value in update.agent.state_dict().items() if not torch.equal(value, before[name])}
        assert plan.trains_policy == (part(update, "policy.") <= moved)
        assert moved >= part(update, "memory.", "critic.", "world_model.", "log_alpha")
        moves += [number] if part(update, "policy.") & moved else []
        said += [number] if "policy_loss" in updated.metrics else []
    assert moves == said == [3, 6]


def test_a_runs_first_update_is_of_whole_windows_so_that_too_large_ones_end_at_once() -> None:
    update, long = make(ROBUST), dataclasses.replace(SPEC, train=60)
    raw = torch.from_numpy(random_rows(8, spec=long, longest=10).view("u1").reshape(8, -1))
    steps = [update.plan(raw, long, number).steps for number in (1, 2)]
    assert steps == [long.steps, longest_steps(raw, long)]
    assert steps[0] > steps[1]


@pytest.mark.parametrize("half", ["model_pass", "actor_critic_pass"])
def test_a_loss_that_no_stage_takes_is_an_error(half: str, monkeypatch: pytest.MonkeyPatch) -> None:
    update = make(ROBUST, update_order="alternate")
    made = getattr(update, half)

    def with_another(*given: object) -> object:
        of_losses, passed = made(*given)
        return of_losses | {"weight_loss": update.agent.log_alpha.square()}, passed

    monkeypatch.setattr(update, half, with_another)
    with pytest.raises(AssertionError, match="a loss without a stage"):
        update(to_batch(random_rows(8)), BETA)


def test_an_update_without_the_policys_turn_is_the_update_without_its_loss():
    without, whole = make(ROBUST, scheme=3, policy_delay=2), make(ROBUST, scheme=3)
    raw = torch.from_numpy(random_rows(8).view("u1").reshape(8, -1))
    for update in (without, whole):
        update(view_batch(raw, torch.ones(8), SPEC, update.plan(raw, SPEC, 1)), BETA)
    for name, value in whole.agent.named_parameters():
        assert torch.equal(value, dict(without.agent.named_parameters())[name]) == (not name.startswith("policy."))


def test_both_targets_come_back_as_they_were():
    before, after = (make(ROBUST, latent_target="ema", target_memory="ema", polyak=0.9) for _ in range(2))
    for seed in range(3):
        before(to_batch(random_rows(8, seed)), BETA)
    after.load_state_dict(copy.deepcopy(before.state_dict()))
    for part in ("target_critic", "ema_memory"):
        ours, theirs = getattr(after, part).state_dict(), getattr(before, part).state_dict()
        assert all(torch.equal(ours[name], value) for name, value in theirs.items()), part
    a, b = (update(to_batch(random_rows(8, 3)), BETA) for update in (before, after))
    assert torch.equal(a.priorities, b.priorities)


def test_the_gradients_norm_is_told_as_it_was_before_the_clip():
    clipped, free = (make(ROBUST, clip_norm=norm)(to_batch(random_rows(8)), BETA) for norm in (0.1, 0.0))
    assert clipped.metrics["grad_norm"] == free.metrics["grad_norm"] > 0.2


def test_a_number_that_hardly_changes_is_not_blown_up():
    """Its deviation counts as 0.01 at least (``docs/algorithm.md``)."""
    normalizer, mean, std = Normalizer(3, enabled=True), torch.tensor([1.0, 0.0, 2.0]), torch.tensor([1e-3, 0.0, 0.5])
    normalizer.freeze(torch.tensor(100), 100.0 * mean.double(), 100.0 * (mean.double() ** 2 + std.double() ** 2))
    torch.testing.assert_close(normalizer.std, torch.tensor([0.01, 0.01, 0.5]))
    torch.testing.assert_close(normalizer.scaled(mean + 0.005), torch.tensor([0.5, 0.5, 0.01]), rtol=1e-4, atol=1e-4)
