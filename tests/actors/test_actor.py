"""The actor over an in-process bus and over a real Redis: each step once, in order, within its credit."""

import contextlib
import dataclasses
import itertools
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest
import torch
from safetensors.torch import save

from rmc.actors.actor import Actor, environment_seed
from rmc.actors.config import ActorConfig
from rmc.actors.env_pool import EnvPool
from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.bus.protocol import Ack, Bus, Entry, EntryId, ReplayOwner, Version
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.env.config import EnvConfig
from rmc.common.env.make import make_env
from rmc.common.errors import BusFull, BusUnavailable, EnvFault, FencedError, MessageError
from rmc.common.window import Rows, WindowSpec, joined
from rmc.common.wire import decode_rows
from tests.broken_env import BREAKS_AT, FAULTS
from tests.counting_env import ACTION_DIM, OBS_DIM, CountingEnv, Step, audit
from tests.habits import Dead
from tests.learner.rows import step_valid
from tests.raising import raising

AGENT = AgentConfig(hidden=8, embedding=8, heads=(8, 8))
SPEC = WindowSpec(OBS_DIM, ACTION_DIM, AGENT.hidden, burn_in=4, train=6)
CONFIG = ActorConfig(envs_per_actor=4, stride=6, refresh_steps=50, chunk_windows=5)
COUNTING = EnvConfig("tests.counting_env:Counting-v0")


@pytest.fixture(params=["memory", "redis"])
def bus(request: pytest.FixtureRequest, redis_url: str, run_name: str) -> Bus:
    return MemoryBus() if request.param == "memory" else RedisBus(redis_url, run_name)


def make_actor(
    bus: Bus,
    index: int = 0,
    seed: int = 1,
    config: ActorConfig = CONFIG,
    make: Callable[[], Any] = lambda: make_env(COUNTING),
) -> Actor:
    """Its clock counts calls, so that no test waits for a timer."""
    clock: Callable[[], float] = itertools.count().__next__
    return Actor(index, seed, make, SPEC, AGENT, config, bus, clock)


def publish(bus: Bus, update: int) -> bytes:
    blob: bytes = save(Agent(OBS_DIM, ACTION_DIM, AGENT).policy_weights())
    bus.publish_weights(Version(1, update), blob)
    return blob


class Reader:
    """Reads and acknowledges as a replay server does, and keeps what it read."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self.owner = bus, ReplayOwner("replay", bus.take_epoch("replay"))
        self._cursors: dict[int, EntryId] = {}
        self.entries: list[Entry] = []

    def read(self, granted_steps: int, final: bool = False) -> None:
        for actor in self._bus.actors():
            self._cursors.setdefault(actor, EntryId(0, 0))
        for entry in self._bus.read(self._cursors, count=1000):
            self.entries.append(entry)
            self._cursors[entry.actor] = entry.id
        acks = {actor: Ack(cursor, granted_steps, final) for actor, cursor in self._cursors.items()}
        self._bus.commit(self.owner, acks)

    def rows(self) -> Rows:
        return joined([decode_rows(entry.payload, SPEC) for entry in self.entries], SPEC)


def begun(bus: Bus, **how: Any) -> tuple[Actor, Reader]:
    """An actor that has untrained weights, and who reads what it sends."""
    publish(bus, 0)
    return make_actor(bus, **how), Reader(bus)


def step_until_blocked(actor: Actor, limit: int = 10_000) -> int:
    for steps in range(limit):
        if not actor.step():
            return steps
    raise AssertionError("never blocked")


def play(actor: Actor, reader: Reader, steps: int, final: bool = True) -> None:
    """So many steps, in several grants; with ``final`` everything open is sent at the end."""
    for granted in range(100, steps + 1, 100):
        reader.read(granted)
        step_until_blocked(actor)
    reader.read(steps, final)
    step_until_blocked(actor)
    reader.read(steps, final)


def assert_each_step_once(rows: Rows, steps: int) -> None:
    """Every environment's steps from its first one on, without a gap, in order of arrival."""
    counts = audit(rows, SPEC)
    assert set(counts.trained.values()) == {1}
    assert counts.trained.total() == counts.new_steps == steps
    by_env: dict[int, list[Step]] = {}
    for step in counts.trained:  # a Counter keeps the order of arrival
        by_env.setdefault(step.env, []).append(step)
    for names in by_env.values():
        assert names == sorted(names)
        for before, after in itertools.pairwise(names):
            assert after in (before._replace(step=before.step + 1), Step(before.env, before.episode + 1, 0))


def test_each_step_once_in_order(bus: Bus) -> None:
    publish(bus, 0)
    actors, reader = [make_actor(bus, index) for index in range(2)], Reader(bus)
    for actor in actors:
        play(actor, reader, 1000)
    assert_each_step_once(reader.rows(), 2000)
    rows = reader.rows()
    origins = [tuple(int(row[name]) for name in ("actor", "epoch", "seq", "k")) for row in rows]
    assert len(set(origins)) == len(origins)
    for index, actor in enumerate(actors):
        ids = [entry.id for entry in reader.entries if entry.actor == index]
        assert ids == [EntryId(1, seq) for seq in range(len(ids))]
        assert not actor.step()
        assert actor.metrics()["unacked_entries"] == 0


def test_waits_for_weights_then_credit_then_stops_at_its_credit(bus: Bus) -> None:
    actor, reader = make_actor(bus), Reader(bus)
    assert (actor.step(), actor.waiting_for()) == (False, "weights")
    publish(bus, 0)
    assert (actor.step(), actor.waiting_for()) == (False, "credit")
    for granted in (4, 42, 43, 200):
        reader.read(granted)
        step_until_blocked(actor)
        assert (actor.step(), actor.waiting_for()) == (False, "credit")
        assert actor.metrics()["env_steps"] == -(-granted // 4) * 4  # past its grant by less than one vector step


def test_credit_of_an_earlier_epoch_is_none(bus: Bus) -> None:
    publish(bus, 0)
    make_actor(bus).close()
    reader = Reader(bus)
    reader.read(1000)
    actor = make_actor(bus)
    assert (actor.step(), actor.waiting_for()) == (False, "credit")


def test_final_credit_flushes_open_windows_and_more_credit_goes_on(bus: Bus) -> None:
    actor, reader = begun(bus)
    reader.read(20)
    step_until_blocked(actor)
    reader.read(20)
    assert reader.rows()["new_steps"].sum() < 20  # five steps of each of four: mostly open
    reader.read(20, final=True)
    step_until_blocked(actor)
    assert actor.waiting_for() == "the end"
    reader.read(20, final=True)
    assert_each_step_once_with_cuts(reader.rows(), 20)
    for _ in range(20):
        assert not actor.step()  # nothing is cut twice
    reader.read(100, final=True)
    step_until_blocked(actor)
    reader.read(100, final=True)
    assert_each_step_once_with_cuts(reader.rows(), 100)


def assert_each_step_once_with_cuts(rows: Rows, steps: int) -> None:
    """As above, but an episode may go no further after a cut."""
    counts = audit(rows, SPEC)
    assert set(counts.trained.values()) == {1}
    assert counts.trained.total() == counts.new_steps == steps


def test_a_full_resend_buffer_makes_it_wait(bus: Bus) -> None:
    config = ActorConfig(envs_per_actor=2, stride=6, chunk_windows=1, unacked_bytes=3 * SPEC.dtype.itemsize)
    actor, reader = begun(bus, config=config)
    reader.read(100_000)
    step_until_blocked(actor)
    assert actor.waiting_for() == "acknowledgements"
    steps = actor.metrics()["env_steps"]
    assert 0 < steps < 200
    reader.read(100_000)
    step_until_blocked(actor)
    assert actor.metrics()["env_steps"] > steps


def test_random_phase_and_newer_weights(bus: Bus) -> None:
    actor, reader = begun(bus)
    play(actor, reader, 400, final=False)
    actions = reader.rows()
    assert set(actions["weights_update"].tolist()) == {0}
    valid = actions["action"][step_valid(actions, SPEC)]
    assert abs(valid.mean()) < 0.1
    assert valid.std() == pytest.approx(1 / np.sqrt(3), abs=0.05)
    publish(bus, 7)
    play(actor, reader, 800)
    versions = reader.rows()["weights_update"]
    assert set(versions.tolist()) == {0, 7}
    assert actor.metrics()["weights_update"] == 7
    assert (reader.rows()["new_steps"][versions == 0].sum()) <= 400 + CONFIG.refresh_steps + 4 * SPEC.steps


def test_a_policy_that_cannot_be_read_is_refused_and_the_one_before_goes_on(bus: Bus) -> None:
    bus.publish_weights(Version(1, 2), b"no policy")
    actor, reader = make_actor(bus), Reader(bus)
    reader.read(400)
    for _ in range(5):
        assert not actor.step()
    assert actor.waiting_for() == "weights"
    assert actor.metrics()["refused_weights"] == 1  # it is not read again
    publish(bus, 3)
    step_until_blocked(actor)
    bus.publish_weights(Version(1, 8), b"no policy")
    reader.read(800)
    step_until_blocked(actor)
    record = actor.metrics()
    assert record["env_steps"] == 800
    assert record["weights_update"] == 3
    assert record["refused_weights"] == 2


def test_a_policy_whose_critics_are_refused_does_not_act(bus: Bus) -> None:
    refusing = SimpleNamespace(load=raising(MessageError("weights", "without critics")), reseed=lambda _: None)
    publish(bus, 7)
    actor = make_actor(bus)
    actor._priority_fn = refusing
    loaded: list[bytes] = []
    actor._runner.load = loaded.append
    assert not actor.step()
    assert (actor.metrics()["refused_weights"], loaded) == (1, [])


def test_metrics() -> None:
    bus = MemoryBus()
    publish(bus, 3)
    actor, reader = make_actor(bus), Reader(bus)
    reader.read(400)
    step_until_blocked(actor)
    publish(bus, 9)
    reader.read(800)
    step_until_blocked(actor)
    record = actor.metrics()
    assert record["policy_lag"] == pytest.approx(6)
    assert record["episodes"] > 10
    assert 1 <= record["episode_length_mean"] <= 40
    assert record["episode_return_mean"] > record["episode_length_mean"]  # a step's reward is its number
    assert "episode_return_mean" not in actor.metrics()


def test_seeds() -> None:
    """No two of actor, epoch, environment and run share a seed; a restart begins other episodes."""
    names = list(itertools.product(range(3), range(3), range(3), range(-1, 3)))
    assert len({environment_seed(*name) for name in names}) == len(names)
    assert all(0 <= environment_seed(*name) < 2**31 for name in names)

    def first_steps(seed: int, restarts: int) -> set[Step]:
        actor, reader = begun(MemoryBus(), seed=seed)
        for _ in range(restarts):
            actor.restart()
        play(actor, reader, 200)
        return set(audit(reader.rows(), SPEC).trained)

    assert first_steps(1, 0) == first_steps(1, 0)
    assert {step.env for step in first_steps(1, 0)}.isdisjoint(step.env for step in first_steps(1, 1))
    assert {step.env for step in first_steps(1, 0)}.isdisjoint(step.env for step in first_steps(2, 0))


def test_same_seed_same_bits() -> None:
    def played() -> bytes:
        bus = MemoryBus()
        bus.publish_weights(Version(1, 5), blob)
        actor, reader = make_actor(bus), Reader(bus)
        play(actor, reader, 500)
        actor.restart()
        play(actor, reader, 500)
        return reader.rows().tobytes()

    blob = publish(MemoryBus(), 5)
    assert played() == played()


def test_what_is_sent_again_is_counted_once_however_often_a_restart_fails() -> None:
    bus = MemoryBus()
    actor, reader = begun(bus)
    play(actor, reader, 200, final=False)
    actor._unacked.send_again()
    before = actor.metrics()["resends"]
    assert before > 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bus, "take_epoch", Mock(side_effect=BusUnavailable("gone")))
        for _ in range(3):
            with pytest.raises(BusUnavailable):
                actor.restart()
            assert actor.metrics()["resends"] == before
    actor.restart()
    assert actor.metrics()["resends"] == before


def test_restart_begins_a_new_epoch_without_what_was_open() -> None:
    actor, reader = begun(MemoryBus())
    play(actor, reader, 300, final=False)
    played = actor.metrics()["env_steps"]
    actor.restart()
    assert actor.metrics()["env_steps"] == played >= 300  # those of all its epochs
    assert (actor.step(), actor.waiting_for()) == (False, "credit")  # it has the weights again, its credit is old
    play(actor, reader, 300)
    rows = reader.rows()
    assert set(rows["epoch"].tolist()) == {1, 2}
    later = rows["epoch"] == 2
    assert_each_step_once(rows[later], 300)
    assert audit(rows, SPEC).trained.total() <= 600


class Unsteady(MemoryBus):
    """Fails appends as told; with ``stored`` the entry arrives but its reply is lost."""

    def __init__(self, failures: list[tuple[type[Exception], bool] | None]) -> None:
        super().__init__()
        self.failures = iter(failures)
        self.appended = 0

    def append(self, actor: int, entry_id: EntryId, payload: bytes) -> None:
        failure = next(self.failures, None)
        if failure is None or failure[1]:
            self.appended += 1
            super().append(actor, entry_id, payload)
        if failure is not None:
            raise failure[0]("as told")


def test_a_failed_append_loses_and_repeats_nothing() -> None:
    kinds = [None, (BusUnavailable, False), (BusUnavailable, True), (BusFull, False)]
    rng = np.random.default_rng(0)
    bus = Unsteady([kinds[i] for i in rng.integers(0, 4, 400)])
    actor, reader = begun(bus)
    reader.read(1000)
    for attempt in range(5000):
        try:
            if not actor.step():
                reader.read(1000, final=True)
        except (BusUnavailable, BusFull):
            continue
        if attempt > 100 and actor.waiting_for() == "the end" and not actor.metrics()["unacked_entries"]:
            break
    assert actor.metrics()["env_steps"] == 1000
    assert actor.metrics()["resends"] > 0
    assert_each_step_once_with_cuts(reader.rows(), 1000)


@pytest.mark.parametrize("then_steps", [True, False], ids=["while stepping", "while waiting"])
def test_a_redis_that_forgot_everything_gets_it_again(redis_url: str, run_name: str, then_steps: bool) -> None:
    bus = RedisBus(redis_url, run_name)
    actor, reader = begun(bus)
    play(actor, reader, 200, final=False)
    unread = 600 if then_steps else 300
    reader.read(unread)
    for _ in range(30 if then_steps else 200):
        actor.step()
    _forget(bus)
    with contextlib.suppress(BusUnavailable):  # run_role waits here, and goes on
        for _ in range(100):
            actor.step()
    for _ in range(100):
        actor.step()
    assert bus.actors() == [0]  # it has said hello again
    reader.read(unread, final=True)
    step_until_blocked(actor)
    reader.read(unread, final=True)
    assert_each_step_once_with_cuts(reader.rows(), unread)
    assert actor.metrics()["resends"] > 0


def test_a_hello_that_redis_forgot_is_said_again(redis_url: str, run_name: str) -> None:
    bus = RedisBus(redis_url, run_name)
    publish(bus, 0)
    actor = make_actor(bus)
    assert bus.actors() == [0]
    _forget(bus)  # before any replay server has read it
    for _ in range(100):
        actor.step()
    assert bus.actors() == [0]


def _forget(bus: RedisBus) -> None:
    """All but the replay's epoch, which a restarted replay server would take anew."""
    for key in bus.redis.scan_iter():  # by no pattern: the name of a test has brackets
        if key.startswith(f"{bus.prefix}:".encode()) and not key.endswith(b":epoch:replay"):
            bus.redis.delete(key)


def test_a_replaced_actor_ends(bus: Bus) -> None:
    old, reader = begun(bus)
    reader.read(1000)
    old.step()
    new = make_actor(bus)
    with pytest.raises(FencedError):
        step_until_blocked(old)
    old.close()  # quietly
    play(new, reader, 200)
    assert {int(epoch) for epoch in reader.rows()["epoch"]} == {2}


def test_epochs_that_redis_forgot_do_not_strand_the_actor(bus: Bus) -> None:
    """The ring remembers entry 1-7 of this actor; a Redis that came back empty hands out epoch 1 again."""
    publish(bus, 3)
    actor = make_actor(bus)
    replay = ReplayOwner("replay", bus.take_epoch("replay"))
    bus.commit(replay, {0: Ack(EntryId(1, 7), 400)})
    step_until_blocked(actor)
    assert bus.current_epoch("actor-0") == 2
    bus.commit(replay, {0: Ack(EntryId(2, 0), 40)})
    assert step_until_blocked(actor) == 10


def test_a_life_that_the_ring_forgot_is_begun_anew(bus: Bus) -> None:
    """A replay server with an empty ring grants less than it had acknowledged: waiting would never end."""
    actor, reader = begun(bus)
    play(actor, reader, 400, final=False)
    reader.read(60)
    assert not actor.step()
    assert bus.current_epoch("actor-0") == 2
    play(actor, reader, 300)
    later = reader.rows()[reader.rows()["epoch"] == 2]
    assert_each_step_once(later, 300)


def test_a_redis_that_is_back_as_it_was_ends_no_life(bus: Bus) -> None:
    """It has an older ack; the replay server, which forgot nothing, repeats its own soon."""
    actor, reader = begun(bus)
    play(actor, reader, 200, final=False)
    old = bus.ack(0)
    assert old is not None
    for granted in (300, 400):
        reader.read(granted)
        step_until_blocked(actor)
    reader.read(400)
    newest = bus.ack(0)
    assert newest is not None
    for published in (old, newest, old):
        bus.commit(reader.owner, {0: published})
        actor.step()
        assert actor.waiting_for() == "credit"
    assert bus.current_epoch("actor-0") == 1
    for _ in range(60):  # it stays: the ring has forgotten the newest
        actor.step()
    assert bus.current_epoch("actor-0") == 2


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_episode_ends_with_the_step_before_and_training_goes_on(fault: str) -> None:
    """What was seen of it before is sound; nothing of the step that broke is, and it costs no credit."""
    actor, reader = begun(MemoryBus(), make=lambda: make_env(EnvConfig(f"tests.broken_env:Broken-{fault}-v0")))
    play(actor, reader, 2000)
    rows = reader.rows()
    counts = audit(rows, SPEC)
    assert set(counts.trained.values()) == {1}
    assert counts.trained.total() == counts.new_steps  # as many as were granted, broken ones not among them
    assert 2000 <= counts.new_steps < 2000 + CONFIG.envs_per_actor
    assert np.isfinite(rows["observation"]).all()
    assert actor.metrics()["broken_episodes"] > 10
    sent = {step.step for step in counts.trained if step.episode % 3 == 2}
    assert sent == set(range(BREAKS_AT - 1))  # those before the one that broke


def test_an_environment_that_always_breaks_early_is_learnt_from_up_to_there() -> None:
    """Whatever its strategy, what was sound reaches the replay, as of an episode that was cut off."""
    for strategy in ("burn-in", "episode"):
        config = dataclasses.replace(CONFIG, state_strategy=strategy)  # type: ignore[arg-type]
        env = EnvConfig("tests.broken_env:Early-v0")
        actor, reader = begun(MemoryBus(), config=config, make=partial(make_env, env))
        play(actor, reader, 300)
        rows = reader.rows()
        counts = audit(rows, SPEC)
        assert counts.new_steps >= 300
        assert {step.step for step in counts.trained} == {0, 1}
        assert not rows["terminated"].any()


def test_what_critics_are_not_asked_to_read_is_the_environments_own_affair() -> None:
    class Gives(gym.Wrapper[Any, Any, Any, Any]):
        def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
            return self.env.reset(**options)[0], {"privileged": [[1.0], [1.0, 2.0]]}

    actor, reader = begun(MemoryBus(), make=lambda: Gives(make_env(COUNTING)))
    play(actor, reader, 60)
    assert actor.metrics()["broken_episodes"] == 0


def test_a_fault_is_logged_with_its_place_in_the_users_file(caplog: pytest.LogCaptureFixture) -> None:
    play(*begun(MemoryBus(), make=lambda: make_env(EnvConfig("tests.broken_env:Broken-raise-v0"))), 500)
    messages = [record.getMessage() for record in caplog.records if "broke in step" in record.getMessage()]
    assert messages
    fault = r"the environment's step raises RuntimeError: the simulation is unstable \(broken_env.py, line \d+\)$"
    assert all(
        re.search(f"^actor-0: environment [0-9] broke in step [0-9]+ of an episode: {fault}", line) for line in messages
    )


class Scaling(CountingEnv):
    """Changes the very array that it is given."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        action *= 3
        return super().step(action)


gym.register("Scaling-v0", entry_point=Scaling)


def test_a_window_holds_the_agents_own_actions() -> None:
    actor, reader = begun(MemoryBus(), make=lambda: make_env(EnvConfig("Scaling-v0")))
    play(actor, reader, 500)
    rows = reader.rows()
    assert 0.9 < np.abs(rows["action"]).max() <= 1.0
    assert 0.9 < np.abs(rows["prev_action"]).max() <= 1.0


def test_an_environment_that_always_breaks_at_once_ends_the_actor() -> None:
    actor, reader = begun(MemoryBus(), make=lambda: Dead(make_env(COUNTING)))
    with pytest.raises(RuntimeError, match="it is dead"):
        play(actor, reader, 2000)


def test_a_reset_that_breaks_is_tried_once_more_on_a_new_environment() -> None:
    actor, reader = begun(MemoryBus())

    class BreaksAtReset(gym.Wrapper[Any, Any, Any, Any]):
        def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
            raise EnvFault("it is broken")

    actor._envs._envs[2] = BreaksAtReset(actor._envs._envs[2])
    play(actor, reader, 1000)
    assert actor.metrics()["broken_episodes"] == 1
    assert audit(reader.rows(), SPEC).trained.total() == 1000


@pytest.mark.parametrize("call", ["step", "reset"])
def test_one_that_can_exist_only_once_is_made_anew(call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RMC_TEST_LOCK", str(tmp_path / "lock"))
    env = EnvConfig("tests.only_one_env:OnlyOne-v0", env_kwargs={"breaks_in": call})
    config = dataclasses.replace(CONFIG, envs_per_actor=1)
    actor, reader = begun(MemoryBus(), config=config, make=partial(make_env, env))
    play(actor, reader, 300)
    assert actor.metrics()["broken_episodes"] > 2
    assert_each_step_once_with_cuts(reader.rows(), 300)


def test_a_reward_that_the_scale_makes_infinite_breaks_the_episode() -> None:
    """Else the replay server would refuse all windows of its entry."""

    class Explodes(gym.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            observation, _, *rest = self.env.step(action)
            return observation, 1e33 if observation[3] == 5.0 else 1.0, *rest

    config = dataclasses.replace(CONFIG, reward_scale=1e6)
    actor, reader = begun(MemoryBus(), config=config, make=lambda: Explodes(make_env(COUNTING)))
    play(actor, reader, 1000)
    assert actor.metrics()["broken_episodes"] > 0
    assert np.isfinite(reader.rows()["reward"]).all()


def test_returns_are_the_environments_own_whatever_scales_its_rewards() -> None:
    records = []
    for scale in (1.0, 0.5):
        config = dataclasses.replace(CONFIG, reward_scale=scale)
        actor, reader = begun(MemoryBus(), config=config)
        play(actor, reader, 1000)
        records.append((actor.metrics()["episode_return_mean"], float(reader.rows()["reward"].max())))
    assert records[0][0] == records[1][0]
    assert records[0][1] == 2 * records[1][1]


def test_environments_made_anew_begin_by_seeds_that_no_other_has() -> None:
    seeds = []

    class Noted(gym.Wrapper[Any, Any, Any, Any]):
        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            seeds.extend([] if seed is None else [seed])
            return self.env.reset(seed=seed, options=options)

    pool = EnvPool(lambda: Noted(make_env(COUNTING)), 3, SPEC, "actor-0")
    pool.restart(int)
    for i in range(3):
        pool.begin(i)
    for i in (0, 1, 0, 2):
        pool.replace(i, EnvFault("it is broken"), step=5)
        pool.begin(i)
    pool.close()
    assert len(set(seeds)) == len(seeds) == 7


@pytest.mark.parametrize("known", [False, True])
def test_a_frame_that_no_statistics_normalise_is_stored_as_none_seen(known: bool) -> None:
    """The learner, which knows them by then, would take raw numbers for normalised ones. A warm start brings them."""
    agent = dataclasses.replace(AGENT, normalize_observations=True, impute_missing=True)
    spec = WindowSpec(OBS_DIM, ACTION_DIM, agent.state_size(OBS_DIM), burn_in=4, train=6)
    bus: Bus = MemoryBus()
    clock: Callable[[], float] = itertools.count().__next__
    actor = Actor(0, 1, lambda: make_env(COUNTING), spec, agent, CONFIG, bus, clock)
    reader = Reader(bus)
    for update in (0, 20):
        made = Agent(OBS_DIM, ACTION_DIM, agent)
        if known or update:
            made.freeze_statistics(torch.tensor([10.0]), torch.full((OBS_DIM,), 5.0), torch.full((OBS_DIM,), 9.0))
        bus.publish_weights(Version(1, update), save(made.policy_weights()))
        play(actor, reader, 500 if update else 300, final=bool(update))
    rows = joined([decode_rows(entry.payload, spec) for entry in reader.entries], spec)
    later = rows["state"].any(1)  # at an episode's start nothing is remembered
    seen, trained = rows["state"][:, agent.hidden :].any(1), rows["weights_update"] > 0
    assert (seen[later & trained].mean(), seen[later & ~trained].mean()) == (1.0, float(known))


def test_an_environment_that_breaks_now_and_then_at_once_goes_on() -> None:
    """Five times in a row is too often; sound episodes in between end the row."""
    episodes = itertools.count()

    class BreaksAtTimes(gym.Wrapper[Any, Any, Any, Any]):
        def reset(self, **options: Any) -> Any:
            self._breaks = next(episodes) % 3 == 0
            return self.env.reset(**options)

        def step(self, action: Any) -> Any:
            if self._breaks:
                raise RuntimeError("it breaks")
            return self.env.step(action)

    actor, reader = begun(MemoryBus(), make=lambda: BreaksAtTimes(make_env(COUNTING)))
    play(actor, reader, 2000)
    assert actor.metrics()["broken_episodes"] > 20
