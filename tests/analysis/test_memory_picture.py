"""What an agent remembers: of memories that are built by hand, and beside slow loops."""

import dataclasses
import io
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from rich.console import Console

from rmc.analysis import memory_picture
from rmc.analysis.episodes import Episode, HiddenPart, Player, hidden_parts, recorded, unroll_episode
from rmc.analysis.influence import ReplayedEpisode, _changes, influence
from rmc.analysis.memory_picture import MemoryInsight, examine_memory, tables
from rmc.analysis.memory_probe import Samples, _of_part, explained, probes, samples
from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.common.env.config import EnvConfig
from rmc.common.env.make import make_env
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import RunConfig
from tests.memory_env import MemoryEnv
from tests.runs import AGENTS

PLAIN = AgentConfig(hidden=4, embedding=0, heads=(10, 9))
MEMORY = RunConfig(env=EnvConfig("tests.memory_env:Memory12-v0"), preset="debug", agent=PLAIN)
ASLEEP, AWAKE = 5.0, -20.0  # of the update gate: it keeps what was, or takes what comes


def built(gate: float) -> Agent:
    """An agent whose memory reads its input through a gate that is always as open: it holds all, or forgets at once."""
    torch.manual_seed(0)
    agent, size = Agent(2, 1, PLAIN), PLAIN.hidden
    with torch.no_grad():
        agent.memory.gru.weight_hh_l0.zero_()
        agent.memory.gru.weight_ih_l0[: 2 * size].zero_()
        agent.memory.gru.bias_ih_l0.zero_()
        agent.memory.gru.bias_hh_l0.zero_()
        agent.memory.gru.bias_ih_l0[size : 2 * size] = gate
    return agent.eval()


def played(config: RunConfig, agent: Agent) -> tuple[list[Episode], list[HiddenPart]]:
    with closing(Player(agent, config)) as player:
        return player.several(), player.hidden_parts()


@pytest.fixture(scope="module")
def of_memory_env() -> list[Episode]:
    return played(MEMORY, built(ASLEEP))[0]


def test_a_memory_that_holds_its_input_shows_it_at_every_delay_and_one_that_does_not_at_none(
    of_memory_env: list[Episode],
) -> None:
    holds, forgets = (influence(built(gate), of_memory_env) for gate in (ASLEEP, AWAKE))
    assert holds[0].delays == forgets[0].delays == (1, 2, 3, 5, 7, 10, 15)  # of 16 steps
    for one in holds[0].changes.values():
        assert (one > 0.005).all()
        assert one[-1] > 0.8 * one[0]
    for kept, gone in zip(holds, forgets, strict=True):
        assert kept.delays
        for values in gone.changes.values():
            assert (values < 1e-4).all()


def test_the_cue_can_be_read_out_of_the_memory_that_holds_it(of_memory_env: list[Episode]) -> None:
    holds, forgets = built(ASLEEP), built(AWAKE)
    (held,) = probes(holds, forgets.memory, of_memory_env, [])
    (gone,) = probes(forgets, holds.memory, of_memory_env, [])
    assert held.name == gone.name == "cue"
    assert min(held.from_memory, gone.from_untrained) > 0.9
    # what is forgotten was seen in one step of 17
    assert max(gone.from_memory, held.from_untrained, held.from_newest, gone.from_newest) < 0.3
    assert len(of_memory_env) == 64


@pytest.mark.parametrize("agent", ["robust", "filling blanks", "observation beside", "without a memory"])
def test_differences_are_those_of_two_whole_passes(agent: str) -> None:
    """From the state before the change on, or over the whole episode: the same."""
    env = EnvConfig("Pendulum-v1", flicker=0.3, time_limit=30)
    config = RunConfig(env, preset="debug", seed=4, agent=AGENTS[agent])
    torch.manual_seed(0)
    network = Agent(3, 1, config.agent).eval()
    with closing(Player(network, config)) as player:
        episode = player.play()
    replay, delays = ReplayedEpisode(network, episode), torch.tensor([0, 1, 4, 9])
    starts = [start for start in (0, 1, 5, 8, 13, 19) if not episode.missing[0, start]]
    assert len(starts) >= 3
    change = torch.tensor([[0.0, 0.5, 0.0], [-1.0, 0.0, 0.0]])
    with torch.no_grad():
        for start in starts:
            found = replay.differences(start, change, delays)
            for row in range(len(change)):
                observation = episode.observation.clone()
                observation[0, start] += change[row]
                other = dataclasses.replace(episode, observation=observation)
                for k, delay in enumerate(delays.tolist()):
                    at = start + delay
                    outputs = [at_step(network, each, at) for each in (other, episode)]
                    for values, new, old in zip(found, *outputs, strict=True):
                        torch.testing.assert_close(values[row, k], new - old, atol=1e-5, rtol=1e-4)


def at_step(agent: Agent, episode: Episode, t: int) -> tuple[torch.Tensor, ...]:
    """h (H,), Q (1,) and the mean action (A,) there."""
    memory, _ = unroll_episode(agent, episode)
    z = agent.features(memory)[:, t : t + 1]
    q = agent.critic(z, episode.action[:, t : t + 1]).mean(0)
    return memory.hidden[0, t], q[0], torch.tanh(agent.policy(z)[0])[0, 0]


def test_what_is_hidden_and_when() -> None:
    def of(env_id: str, **options: Any) -> list[HiddenPart]:
        config = EnvConfig(env_id, **options)
        env = make_env(config)
        parts = hidden_parts(env, config)
        env.close()
        return parts

    cheetah = "HalfCheetah-v5"
    assert of(cheetah) == of("Pendulum-v1", frame_stack=2) == []
    velocities, positions = (
        HiddenPart("qvel", slice(8, 17), False, slice(8, 17)),
        HiddenPart("qpos", slice(0, 8), False, slice(0, 8)),
    )
    assert of(cheetah, hide="velocities") == [velocities]
    assert of(cheetah, hide="positions") == [dataclasses.replace(positions, flags=slice(-8, 0))]
    missing = HiddenPart("qpos, where missing", slice(0, 8), True, slice(0, 8))
    (seen,) = (part for part in of(cheetah, hide="positions", drop_sensors=0.5) if part.only_missing)
    assert (seen.columns, seen.flags) == (slice(8, 17), slice(0, 9))
    assert of(cheetah, hide="velocities", flicker=0.5) == [missing, velocities]
    assert of(cheetah, noise=0.1) == [positions, velocities]
    assert of("Pendulum-v1", flicker=0.5) == [HiddenPart("observation, where missing", slice(0, 3), True, slice(0, 3))]
    assert of("Pendulum-v1", flicker=0.5, frame_stack=2) == [HiddenPart("observation", slice(0, 3), False, slice(0, 3))]


@pytest.mark.parametrize(
    "options",
    [{}, {"hide": "velocities", "noise": 0.1, "flicker": 0.4, "frame_stack": 2}, {"hide": "positions", "delay": 3}],
)
def test_the_environments_own_observation_is_recorded_below_all_that_hides_it(options: dict[str, Any]) -> None:
    bare, (env, record) = (
        make_env(EnvConfig("HalfCheetah-v5")),
        recorded(make_env(EnvConfig("HalfCheetah-v5", **options))),
    )
    rng = np.random.default_rng(0)
    plain, _ = bare.reset(seed=3)
    env.reset(seed=3)
    for _ in range(5):
        np.testing.assert_array_equal(record.newest, plain)
        action = rng.uniform(-1.0, 1.0, 6).astype(np.float32)
        plain, seen = bare.step(action)[0], env.step(action)[0]
        assert options or (seen == record.newest).all()
    env.close()
    bare.close()


def test_a_sensor_that_fails_alone_is_read_where_it_failed() -> None:
    """White noise: nothing tells of it but the sensor itself, which the newest observation holds where it is seen."""
    rng, rows = np.random.default_rng(0), 4_000
    noise, missing = rng.normal(size=(rows, 3)), rng.random((rows, 3)) < 0.3
    newest, quarter = np.where(missing, 0.0, noise), np.arange(rows) % 4
    parts = HiddenPart("noise, where missing", slice(0, 3), True, slice(0, 3))
    found = _of_part(Samples(newest, newest, newest, noise, {}, missing, quarter), parts)
    assert found is not None
    assert max(found.from_memory, found.from_newest) < 0.02


def test_rows_are_the_memory_beside_what_was_seen_last() -> None:
    config = RunConfig(EnvConfig("Pendulum-v1", flicker=0.5, time_limit=40), preset="debug", agent=AGENTS["robust"])
    agent = Agent(3, 1, config.agent).eval()
    episodes, parts = played(config, agent)
    rows, at = samples(agent, agent.memory, episodes), 0
    np.testing.assert_allclose(rows.untrained, rows.h, atol=1e-5)  # the same memory, along the same filled frames
    for index, episode in enumerate(episodes):
        newest, memory = np.zeros(3), unroll_episode(agent, episode)[0].hidden[0]
        for t in range(41):
            if not episode.missing[0, t]:
                newest = episode.observation[0, t].numpy()
            np.testing.assert_array_equal(rows.newest[at], newest)
            np.testing.assert_allclose(rows.h[at], memory[t].numpy(), rtol=1e-6)
            np.testing.assert_array_equal(rows.own[at], episode.own[t])
            assert (rows.missing[at], rows.quarter[at]) == (bool(episode.missing[0, t]), index % 4)
            at += 1
    (probe,) = probes(agent, agent.memory, episodes, parts)
    wrong = dataclasses.replace(parts[0], columns=slice(0, 0))
    assert probe.name == "observation, where missing"
    assert probes(agent, agent.memory, episodes, [wrong]) == []


def test_what_is_missing_is_not_changed(of_memory_env: list[Episode]) -> None:
    """Else a memory that reads zeros in its place would seem to remember what it never saw."""
    episode = of_memory_env[0]
    size = episode.observation.shape[2]
    missing = torch.zeros(1, episode.missing.shape[1], size, dtype=torch.bool)
    missing[0, 0, 0] = True
    replay = ReplayedEpisode(built(ASLEEP), dataclasses.replace(episode, missing=missing))
    change = _changes(replay, 0, torch.ones(size))
    assert not change[:, 0].any()
    assert (change[1:, 1:].abs().sum(1) > 0).all()


def test_what_the_environment_itself_lacks_is_not_read_out() -> None:
    rng, rows = np.random.default_rng(3), 400
    h, quarter = rng.normal(size=(rows, 2)), np.arange(rows) % 4
    own = h.copy()
    own[::3] = np.nan
    every = np.ones((rows, 1), np.bool_)
    found = _of_part(
        Samples(h, h, np.zeros((rows, 1)), own, {}, every, quarter), HiddenPart("x", slice(0, 2), True, slice(0, 1))
    )
    assert found is not None
    assert found.from_memory > 0.99


def test_a_ridge_regression_reads_what_is_there_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    x, quarter = rng.standard_normal((2_000, 6)), np.arange(2_000) % 4
    y = x @ rng.standard_normal((6, 2))
    noise = rng.standard_normal(y.shape)
    assert explained(x, y, quarter) == pytest.approx(1.0, abs=1e-3)
    assert explained(3.0 * x + 7.0, y - 5.0, quarter) == pytest.approx(1.0, abs=1e-3)  # whatever the units
    assert explained(x, y / y.std(0) + noise, quarter) == pytest.approx(0.5, abs=0.1)
    assert abs(explained(x, noise, quarter)) < 0.05
    wide = rng.standard_normal((400, 300))  # more numbers than training rows: the penalty keeps it from nonsense
    assert explained(wide, rng.standard_normal((400, 1)), np.arange(400) % 4) > -0.7


class Told(MemoryEnv):
    """Its ``info["probe"]`` is what it is made with, but at reset."""

    def __init__(self, probe: Any) -> None:
        super().__init__(delay=3)
        self._probe = probe

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, _ = super().step(action)
        return observation, reward, terminated, truncated, {"probe": self._probe}


gym.register("Told-v0", Told)


@pytest.mark.parametrize("probe", ["x", {}, {"cue": "x"}, {"cue": None}, {"cue": float("nan")}, {"goal": 1.0}], ids=str)
def test_a_probe_that_is_no_dict_of_the_same_numbers_is_named(probe: Any) -> None:
    env = EnvConfig("tests.analysis.test_memory_picture:Told-v0", env_kwargs={"probe": 1.0})
    config = dataclasses.replace(MEMORY, env=env)
    player = Player(built(ASLEEP), config)
    player._env.unwrapped._probe = probe  # type: ignore[attr-defined]
    with closing(player), pytest.raises(ConfigError, match=r'its info\["probe"\] is .*; return a dict of the same'):
        player.play()


class Reuses(MemoryEnv):
    """Writes ``info["probe"]`` into one dict."""

    def reset(self, **options: Any) -> tuple[np.ndarray, dict[str, Any]]:
        observation, _ = super().reset(**options)
        self._probe = {"step": 0.0}
        return observation, {"probe": self._probe}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self._probe["step"] += 1.0
        return *super().step(action)[:4], {"probe": self._probe}


gym.register("Reuses-v0", Reuses, kwargs={"delay": 3})


def test_a_probe_is_read_at_its_step() -> None:
    config = dataclasses.replace(MEMORY, env=EnvConfig("tests.analysis.test_memory_picture:Reuses-v0"))
    with closing(Player(built(ASLEEP), config)) as player:
        steps = player.play().probe["step"]
    assert steps.tolist() == list(range(len(steps)))


class Changing(MemoryEnv):
    """Its ``info["probe"]`` has other names in every episode."""

    count = 0

    def reset(self, **options: Any) -> tuple[np.ndarray, dict[str, Any]]:
        observation, _ = super().reset(**options)
        self.count += 1
        return observation, {"probe": {f"object {self.count}": 0.0}}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return *super().step(action)[:4], {"probe": {f"object {self.count}": 0.0}}


gym.register("Changing-v0", Changing, kwargs={"delay": 3})


def test_a_probe_with_other_names_in_each_episode_is_named() -> None:
    config = dataclasses.replace(MEMORY, env=EnvConfig("tests.analysis.test_memory_picture:Changing-v0"))
    with (
        closing(Player(built(ASLEEP), config)) as player,
        pytest.raises(ConfigError, match=r"names \['object \d'\], then others; return the same names in every episode"),
    ):
        player.several()


def test_both_are_shown_in_panels_and_tables(of_memory_env: list[Episode]) -> None:
    from matplotlib.figure import Figure

    memory = examine_memory(built(ASLEEP), built(AWAKE).memory, of_memory_env, [])
    axes = list(Figure().subplots(memory.panels, 1))
    memory_picture.draw(memory, axes)
    assert {line.get_label() for line in axes[0].lines} >= {"h, first observation", "action, later observation"}
    assert axes[1].get_yticklabels()[0].get_text() == "cue"
    assert MemoryInsight(memory.first, memory.later, []).panels == 1
    output = io.StringIO()
    Console(file=output, width=memory_picture.WIDTH).print(*tables(memory), sep="\n")
    lines = output.getvalue().splitlines()
    assert lines[1].split() == ["changed", "observation", "changes", "1", "step", "later", "5", "10"]
    assert [line.split()[:2] for line in lines[2:8]] == [
        [a, b] for a in ("first", "later") for b in ("h", "Q", "action")
    ]
    assert lines[9].split()[0] == "cue"


def test_what_is_read_is_told_of_episodes_that_nothing_was_fitted_to() -> None:
    x, quarter = np.random.default_rng(0).standard_normal((400, 1)), np.arange(400) % 4
    y = np.where(quarter[:, None] == 3, -x, x)
    assert explained(x, y, quarter) == pytest.approx(-3.0, abs=0.3)
