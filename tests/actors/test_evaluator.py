"""The evaluator: whole deterministic episodes, one after the other, and one record for each policy asked for."""

import itertools
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from safetensors.torch import save

from rmc.actors.config import EvaluatorConfig
from rmc.actors.evaluator import Evaluator, Rollout, evaluation_record, first_start, play_episodes
from rmc.actors.policy_runner import PolicyRunner
from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.bus.metrics_record import is_complete
from rmc.common.bus.protocol import Bus, Version
from rmc.common.env.config import EnvConfig
from rmc.common.env.make import make_env
from rmc.common.env.wrappers import Env, RescaledEnv
from rmc.common.errors import ConfigError, RmcError
from tests.counting_env import ACTION_DIM, OBS_DIM
from tests.habits import Dead

AGENT = AgentConfig(hidden=8, embedding=8, heads=(8, 8))
PENDULUM = EnvConfig("Pendulum-v1")


def counting() -> Env:
    return make_env(EnvConfig("tests.counting_env:Counting-v0"))


def runner_for(agent: Agent) -> PolicyRunner:
    runner = PolicyRunner(agent.obs_dim, agent.action_dim, agent.config, envs=1)
    runner.load(save(agent.policy_weights()))
    return runner


def test_an_environment_plays_each_episode_to_its_end() -> None:
    """A counting episode of n steps returns 1 + … + n; stepping one past its end would fail there."""
    agent = Agent(OBS_DIM, ACTION_DIM, AGENT)
    returns = play_episodes(runner_for(agent), counting, 8, seed=4).returns
    lengths = [int(np.random.Generator(np.random.PCG64(4 + i)).integers(1, 41)) for i in range(8)]
    assert returns == [n * (n + 1) / 2 for n in lengths]
    assert len(set(lengths)) > 3


def test_an_episodes_return_does_not_depend_on_how_many_are_played() -> None:
    """Bit by bit: an episode leaves nothing for the next."""
    runner, cheetah = runner_for(Agent(17, 6, AGENT)), EnvConfig("HalfCheetah-v5", time_limit=30)
    returns = {n: play_episodes(runner, lambda: make_env(cheetah), n, seed=0).returns for n in (1, 3)}
    assert returns[1] == returns[3][:1]
    assert play_episodes(runner, lambda: make_env(cheetah), 1, seed=2).returns == returns[3][2:]


def endless() -> Env:
    pendulum = gym.make("Pendulum-v1").unwrapped
    pendulum.spec = None
    return RescaledEnv(pendulum)


def test_an_episode_without_end_is_judged_by_its_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmc.actors.evaluator.LONGEST_EPISODE", 30)
    match = play_episodes(runner_for(Agent(3, 1, AGENT)), endless, 2, seed=0)
    assert (len(match.returns), match.steps, match.cut) == (2, 60, False)


def test_an_evaluation_that_takes_too_long_is_cut() -> None:
    """What is over counts; where nothing is, the first episode as far as it came. The clock goes on at each look."""
    runner = runner_for(Agent(3, 1, AGENT))

    def pendulum() -> Env:
        return make_env(PENDULUM)  # 200 steps

    def cut_after(seconds: float, episodes: int) -> Rollout:
        clock = itertools.count()
        match = Rollout(runner, pendulum(), pendulum, episodes, 0, seconds, lambda: float(next(clock)))
        while match.step():
            pass
        match.env.close()
        return match

    whole = play_episodes(runner, pendulum, 3, seed=0)
    assert not whole.cut
    for seconds, episodes, over in ((50, 3, 1), (50, 1, 1), (250, 3, 1), (450, 3, 2)):
        match = cut_after(seconds, episodes)
        assert (match.cut, len(match.returns)) == (True, over)
        assert seconds - 4 <= match.steps <= seconds
        assert (match.returns == whole.returns[:over]) is (seconds > 200)
    for seconds in (0, 1e6):
        assert (cut_after(seconds, 3).cut, cut_after(seconds, 3).returns) == (False, whole.returns)


def test_what_picks_the_best_is_not_what_judges_it() -> None:
    """Nor do two seeds' evaluations share a start, of up to a thousand episodes."""
    starts = [first_start(seed, final) for seed in range(100) for final in (False, True)]
    assert min(np.diff(sorted(starts))) > 1_000
    assert min(starts) >= 0
    assert max(starts) < 2**31
    assert starts == [first_start(seed, final) for seed in range(100) for final in (False, True)]


def publish(bus: Bus, update: int, evaluate: bool) -> None:
    agent = Agent(OBS_DIM, ACTION_DIM, AGENT)
    bus.publish_weights(Version(1, update), save(agent.policy_weights()), evaluate)


def step_until_idle(evaluator: Evaluator) -> int:
    return next(count for count in itertools.count() if not evaluator.step())


def test_plays_what_it_is_asked_to_once() -> None:
    bus = MemoryBus()
    evaluator = Evaluator(1, counting, AGENT, EvaluatorConfig(episodes=3), bus, clock=itertools.count().__next__)
    publish(bus, 1, evaluate=False)
    assert (step_until_idle(evaluator), evaluator.metrics()) == (0, {})
    publish(bus, 2, evaluate=True)
    publish(bus, 3, evaluate=True)  # only the newest counts
    assert step_until_idle(evaluator) > 0
    record = evaluator.metrics()
    assert (record["eval_update"], record["eval_episodes"]) == (3, 3)
    assert record["eval_return_mean"] > 0
    assert evaluator.metrics() == {}
    assert step_until_idle(evaluator) == 0
    publish(bus, 4, evaluate=True)
    step_until_idle(evaluator)
    again = evaluator.metrics()
    assert again["eval_update"] == 4
    assert again["eval_return_mean"] == record["eval_return_mean"]  # the same starts
    evaluator.close()


def test_an_older_policy_that_redis_brings_back_is_not_played_again() -> None:
    bus = MemoryBus()
    evaluator = Evaluator(1, counting, AGENT, EvaluatorConfig(episodes=2), bus, clock=itertools.count().__next__)
    publish(bus, 20, evaluate=True)
    step_until_idle(evaluator)
    publish(bus, 10, evaluate=True)
    assert not evaluator.step()
    assert evaluator.metrics()["eval_update"] == 20
    evaluator.close()


def test_a_policy_that_cannot_be_read_is_refused_and_the_next_one_played(caplog: pytest.LogCaptureFixture) -> None:
    bus = MemoryBus()
    evaluator = Evaluator(1, counting, AGENT, EvaluatorConfig(episodes=2), bus, clock=itertools.count().__next__)
    spoilt = Agent(OBS_DIM, ACTION_DIM, AGENT).policy_weights()
    spoilt["policy.net.0.bias"][3] = np.nan
    for update, blob in ((1, b"torn"), (2, save(spoilt))):
        bus.publish_weights(Version(1, update), blob, evaluate=True)
        assert [step_until_idle(evaluator), step_until_idle(evaluator)] == [0, 0]
        assert (evaluator.metrics(), evaluator.metrics()) == ({"refused_weights": update}, {})
    assert len(caplog.records) == 2  # each is said once
    assert "policy.net.0.bias" in caplog.text
    publish(bus, 3, evaluate=True)
    assert step_until_idle(evaluator) > 0
    assert evaluator.metrics()["eval_update"] == 3
    evaluator.close()


def test_close_hands_out_what_is_left() -> None:
    bus = MemoryBus()
    evaluator = Evaluator(1, counting, AGENT, EvaluatorConfig(episodes=2), bus, clock=itertools.count().__next__)
    publish(bus, 5, evaluate=True)
    step_until_idle(evaluator)
    evaluator.close()
    (record,), _ = bus.records({"evaluator": "0"})
    assert (record["role"], record["eval_update"]) == ("evaluator", 5)


def test_nonsense_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"--episodes"):
        Evaluator(1, counting, AGENT, EvaluatorConfig(episodes=0), MemoryBus())


def test_an_episode_that_breaks_is_left_out_and_its_environment_made_anew() -> None:
    runner = runner_for(Agent(OBS_DIM, ACTION_DIM, AGENT))
    sound = play_episodes(runner, counting, 3, seed=4).returns
    counter = itertools.count()
    some = play_episodes(runner, lambda: Dead(counting()) if next(counter) == 0 else counting(), 3, seed=4)
    assert (some.returns, some.broken) == (sound[1:], 1)
    assert not is_complete(evaluation_record(some))
    with pytest.raises(RmcError, match="broke in each of 2 episodes"):
        play_episodes(runner, lambda: Dead(counting()), 2, seed=4)


def test_one_that_can_exist_only_once_is_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RMC_TEST_LOCK", str(tmp_path / "lock"))
    counter = itertools.count()

    def breaking_twice() -> Env:
        breaks_in = "step" if next(counter) < 2 else ""
        return make_env(EnvConfig("tests.only_one_env:OnlyOne-v0", env_kwargs={"breaks_in": breaks_in}))

    played = play_episodes(runner_for(Agent(OBS_DIM, ACTION_DIM, AGENT)), breaking_twice, 3, 0)
    assert (played.broken, len(played.returns)) == (2, 1)


def test_the_evaluator_counts_them_and_makes_new_environments() -> None:
    bus, counter = MemoryBus(), itertools.count()

    def breaking_once() -> Env:
        return Dead(counting()) if next(counter) == 0 else counting()

    config = EvaluatorConfig(episodes=3)
    evaluator = Evaluator(1, breaking_once, AGENT, config, bus, clock=itertools.count().__next__)
    records = []
    for update in (1, 2):
        publish(bus, update, evaluate=True)
        step_until_idle(evaluator)
        records.append(evaluator.metrics())
    assert [(record["eval_broken_episodes"], record["eval_episodes"]) for record in records] == [(1, 2), (0, 3)]
    evaluator.close()


def test_an_evaluation_of_which_nothing_is_left_says_of_what_it_was() -> None:
    bus = MemoryBus()
    evaluator = Evaluator(
        1, lambda: Dead(counting()), AGENT, EvaluatorConfig(episodes=2), bus, clock=itertools.count().__next__
    )
    publish(bus, 7, evaluate=True)
    step_until_idle(evaluator)
    record = evaluator.metrics()
    assert {name: record[name] for name in ("eval_broken_episodes", "eval_update")} == {
        "eval_broken_episodes": 2, "eval_update": 7,
    }  # fmt: skip
    assert "eval_return_mean" not in record
    evaluator.close()


class Scripted:
    """Acts by its own count, and notes what it is given."""

    def __init__(self) -> None:
        self.given: list[tuple[np.ndarray, ...]] = []

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((1, 1), np.float32), np.zeros((1, 1), np.float32)

    def act(self, *given: Any) -> tuple[np.ndarray, np.ndarray]:
        *arrays, noise = given
        assert noise is None
        self.given.append(tuple(array.copy() for array in arrays))
        state = arrays[3] + 1.0
        return 0.01 * state, state


class Noting(gym.Wrapper[Any, Any, Any, Any]):
    """Notes what an environment gives and is given."""

    def __init__(self, env: Env) -> None:
        super().__init__(env)
        self.seen: list[tuple[np.ndarray, np.ndarray]] = []
        self.actions: list[float] = []

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(**options)
        self.seen.append((observation, info["missing"]))
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self.actions.append(float(action[0]))
        observation, *rest, info = self.env.step(action)
        self.seen.append((observation, info["missing"]))
        return observation, *rest, info


def test_a_policy_reads_what_is_seen_what_is_missing_and_what_it_did_before() -> None:
    policy, env = Scripted(), Noting(make_env(EnvConfig("tests.partial_env:Partial-v0")))
    play_episodes(policy, lambda: env, 2, seed=3)
    steps = len(env.actions) // 2
    assert len(policy.given) == len(env.actions) == 2 * steps
    for at, (observation, previous, missing, state) in enumerate(policy.given):
        episode, t = divmod(at, steps)
        seen, flags = env.seen[episode * (steps + 1) + t]
        np.testing.assert_array_equal(observation, [seen])
        np.testing.assert_array_equal(missing, [flags])
        assert (previous.item(), state.item()) == (pytest.approx(0.01 * t), t)
        assert env.actions[at] == pytest.approx(0.01 * (t + 1))
    assert any(flags.any() for _, flags in env.seen)


def test_an_evaluation_is_told_by_mean_and_standard_deviation() -> None:
    rollout = play_episodes(runner_for(Agent(OBS_DIM, ACTION_DIM, AGENT)), counting, 4, seed=4)
    mean = sum(rollout.returns) / 4
    deviation = (sum((one - mean) ** 2 for one in rollout.returns) / 4) ** 0.5
    told = evaluation_record(rollout)
    assert (told["eval_return_mean"], told["eval_return_std"]) == (pytest.approx(mean), pytest.approx(deviation))
    assert 0 < deviation != pytest.approx(deviation**2)


@pytest.mark.parametrize(("keeps", "episode"), [(True, 2), (True, 0), (False, 2)])
def test_an_interrupted_evaluation_keeps_what_is_over_where_it_is_to(keeps: bool, episode: int) -> None:
    """Where nothing is over, or it is not to, the interrupt goes on; its environment is closed at any rate."""
    rollouts: list[Rollout] = []
    env, closed = counting(), []
    env.close = lambda: closed.append(env)  # type: ignore[method-assign]

    def watch(rollout: Rollout) -> None:
        rollouts.append(rollout)
        rollout.keeps = keeps
        if rollout.episode == episode:
            raise KeyboardInterrupt

    runner = runner_for(Agent(OBS_DIM, ACTION_DIM, AGENT))
    with nullcontext() if keeps and episode else pytest.raises(KeyboardInterrupt):
        told = evaluation_record(play_episodes(runner, lambda: env, 5, 4, watch=watch))
        assert (told["eval_episodes"], told["eval_cut"]) == (2, 1)
    assert rollouts[0].returns == play_episodes(runner, counting, 5, 4).returns[:episode]
    assert rollouts[0].stopped is (keeps and episode > 0)
    assert closed


@pytest.mark.parametrize("reward", [np.nan, np.inf])
def test_an_episode_whose_reward_is_not_finite_is_left_out(reward: float) -> None:
    class Explodes(gym.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            observation, _, *rest = self.env.step(action)
            return observation, reward, *rest

    runner, counter = runner_for(Agent(OBS_DIM, ACTION_DIM, AGENT)), itertools.count()
    sound = play_episodes(runner, counting, 3, seed=4).returns
    some = play_episodes(runner, lambda: Explodes(counting()) if next(counter) == 0 else counting(), 3, seed=4)
    assert (some.returns, some.broken) == (sound[1:], 1)
