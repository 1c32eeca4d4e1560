"""rmc inspect: the world model against an episode, in numbers that a slow loop gives, too."""

import dataclasses
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rmc.analysis import episodes, world_model_picture
from rmc.analysis.episodes import Episode, Player
from rmc.analysis.influence import ReplayedEpisode
from rmc.analysis.memory_picture import MemoryInsight, examine_memory
from rmc.analysis.world_model_picture import HORIZONS, inspect, load_agent, look
from rmc.cli import main
from rmc.common.agent import Agent, Memory, initial_agent
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import RunConfig
from tests.command import complaint
from tests.hostile import hostile_state
from tests.runs import AGENTS, run_of


@pytest.fixture
def config(request: pytest.FixtureRequest) -> RunConfig:
    """Of "robust", unless a test names others."""
    env, agent = EnvConfig("Pendulum-v1", flicker=0.1, time_limit=40), AGENTS[getattr(request, "param", "robust")]
    return RunConfig(env=env, preset="debug", agent=agent)


of_three_agents = pytest.mark.parametrize("config", ["robust", "plain", "filling blanks"], indirect=True)


@torch.no_grad()
def rolled_out(agent: Agent, episode: Episode, start: int, horizon: int) -> torch.Tensor:
    """The observation that the model expects ``horizon`` steps after ``start``, one step at a time."""
    hidden, previous = torch.zeros(1, agent.config.hidden), torch.zeros(1, 1, agent.action_dim)
    frame = torch.zeros(1, 1, agent.obs_dim)
    for t in range(start + 1):
        last, frame, missing = frame, episode.observation[:, t : t + 1], episode.missing[:, t : t + 1]
        if agent.config.impute_missing and missing:
            frame = agent.next_frame(hidden.unsqueeze(1), last, previous)
        seen = agent.memory(frame, missing, previous, hidden)
        hidden, previous = seen.hidden[:, 0], episode.action[:, t : t + 1]
    for t in range(start, start + horizon):
        action = episode.action[:, t : t + 1]
        step = agent.world_model(agent.features(seen), action)
        frame = frame + step.observation_change
        skip = frame[..., :0] if agent.config.head_input == "hidden" else frame
        seen = seen._replace(hidden=seen.hidden + step.hidden_change, skip=skip)
    return frame[0, 0]


@of_three_agents
def test_rollouts_are_those_of_a_plain_loop(config: RunConfig, tmp_path: Path) -> None:
    folder = run_of(tmp_path / "run", config)
    agent = load_agent(folder, config, "latest")
    episode = Player(agent, config).play()
    insight = look(agent, episode)
    assert episode.action.shape[1] == 40
    for horizon in HORIZONS:
        assert len(insight.ahead[horizon]) == 40 - horizon + 1
        for start in (0, 7, 40 - horizon):
            wanted = rolled_out(agent, episode, start, horizon)
            np.testing.assert_allclose(insight.ahead[horizon][start], wanted, atol=1e-5)
    seen = episode.seen.numpy().squeeze(-1)
    assert 0 < seen.sum() < 40  # some frames were blank, and are left out
    missing = np.broadcast_to(episode.missing[0, 1:].numpy(), insight.real.shape)
    np.testing.assert_array_equal(np.isnan(insight.real), missing)  # a gap in the picture, no zero
    before = np.concatenate([episode.observation[0, :1].numpy(), insight.real[:-1]])
    error, change = (np.abs(x - insight.real)[seen].sum(0) for x in (insight.ahead[1], before))
    np.testing.assert_allclose(insight.unexplained, error / change, rtol=1e-4)


def test_episodes_are_played_by_the_agents_own_weights_and_with_noise(config: RunConfig, tmp_path: Path) -> None:
    agent = load_agent(run_of(tmp_path / "run", config), config, "latest")
    with torch.no_grad():
        agent.policy.net[-1].bias += 1.0  # type: ignore[operator]  # not as it was saved
        episode = Player(agent, config).play()
        mean, log_std = agent.policy(ReplayedEpisode(agent, episode).features)
    noise = (torch.atanh(episode.action) - mean) / log_std.exp()
    assert abs(noise.mean()) < 0.6  # of 40 steps
    assert 0.6 < noise.std() < 1.4


def test_a_memory_that_never_learnt_is_looked_at_beside(
    config: RunConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, given = dataclasses.replace(config, seed=5), []  # the run's own has not learnt either, of seed 0

    def examine(agent: Agent, untrained: Memory, *of: Any) -> MemoryInsight:
        given.append(untrained.state_dict())
        return examine_memory(agent, untrained, *of)

    monkeypatch.setattr(world_model_picture, "examine_memory", examine)
    inspect(run_of(tmp_path / "run", config).path, "latest", tmp_path / "seen.png")
    torch.testing.assert_close(
        given, [initial_agent(config.window_spec(), config.agent, config.seed).memory.state_dict()]
    )


@of_three_agents
def test_the_command_writes_a_picture_and_says_it_in_numbers(
    config: RunConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = run_of(tmp_path / "run", config)
    assert main.run(["inspect", str(folder.path), "--out", str(tmp_path / "seen.png")]) == 0
    assert (tmp_path / "seen.png").read_bytes().startswith(b"\x89PNG")
    output = capsys.readouterr().out
    assert "% 1 ahead" in output
    assert "% 15 ahead (100% is a guess of no change)" in output
    assert "worst dimensions" in output
    assert re.search(r"^changed observation +changes +1 step later +5 +10 +20 *$", output, re.MULTILINE)
    assert re.search(r"^first +h +(\d+% *){4}$", output, re.MULTILINE)
    assert re.search(r"^observation, where missing( +-?\d\.\d\d){3} *$", output, re.MULTILINE)
    words = ["inspect", str(folder.path), "--out"]
    assert "its folder is not there" in complaint([*words, str(tmp_path / "no" / "seen.png")], capsys)
    assert "ends in .png" in complaint([*words, str(tmp_path / "seen.xyz")], capsys)


def test_weights_that_are_not_finite_are_no_agents(config: RunConfig, tmp_path: Path) -> None:
    folder = run_of(tmp_path / "run", config)
    agent = load_agent(folder, config, "latest")
    agent.log_alpha.data.fill_(torch.nan)
    state = io.BytesIO()
    torch.save({"agent": agent.state_dict()}, state)
    checkpoints = CheckpointFolder(folder.checkpoints)
    checkpoints.save(8, {**checkpoints.load(7), "learner.pt": state.getvalue()})
    with pytest.raises(ConfigError, match=r"--checkpoint='8': its learner.pt .*not finite.*; use another"):
        load_agent(folder, config, "latest")


def test_an_episode_of_one_step_is_drawn(config: RunConfig, tmp_path: Path) -> None:
    """Without warnings of numpy or matplotlib."""
    folder = run_of(tmp_path / "run", dataclasses.replace(config, env=EnvConfig("Pendulum-v1", time_limit=1)))
    assert main.run(["inspect", str(folder.path), "--out", str(tmp_path / "seen.png")]) == 0


def test_critics_of_longer_targets_are_not_compared(
    config: RunConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    longer = dataclasses.replace(config, update=dataclasses.replace(config.update, n_step=5))
    folder = run_of(tmp_path / "run", longer)
    assert main.run(["inspect", str(folder.path), "--out", str(tmp_path / "seen.png")]) == 0
    assert "critics are not compared with returns: that takes --n-step 1" in capsys.readouterr().out


def test_an_episode_that_never_ends_is_looked_at_for_a_while(
    config: RunConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(episodes, "LONGEST_EPISODE", 25)
    scaled = dataclasses.replace(config, actor=dataclasses.replace(config.actor, reward_scale=0.5))
    folder = run_of(tmp_path / "run", scaled)
    agent = load_agent(folder, scaled, "latest")
    short, plain = (Player(agent, run).play() for run in (scaled, config))
    assert short.action.shape[1] == 25
    torch.testing.assert_close(short.reward, 0.5 * plain.reward)  # as the world model has learnt it


def test_a_horizon_at_which_nothing_was_seen_has_no_share(
    config: RunConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Zero would read as a perfect prediction."""
    blind = dataclasses.replace(config, env=dataclasses.replace(config.env, flicker=1.0))
    folder = run_of(tmp_path / "run", blind)
    assert inspect(folder.path, "latest", tmp_path / "out.png")[0].open_loop == {}
    assert main.run(["inspect", str(folder.path), "--out", str(tmp_path / "seen.png")]) == 0
    output = capsys.readouterr().out
    assert output.startswith("no change was seen from one step to the next; the world model is not judged by it\n")
    assert "unexplained" not in output
    assert "worst dimensions" not in output


def test_a_model_without_grounding_has_nothing_to_show(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = RunConfig(env=EnvConfig("Pendulum-v1"), preset="debug", agent=AGENTS["paper"])
    folder = run_of(tmp_path / "run", run)
    assert "--grounding" in complaint(["inspect", str(folder.path), "--out", str(tmp_path / "seen.png")], capsys)


def test_a_checkpoint_never_executes_code(
    config: RunConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, mark = run_of(tmp_path / "run", config), tmp_path / "owned"
    checkpoints = CheckpointFolder(folder.checkpoints)
    checkpoints.save(8, {**checkpoints.load(7), "learner.pt": hostile_state(mark)})
    words = ["inspect", str(folder.path), "--out", str(tmp_path / "seen.png")]
    assert "--checkpoint='8': its learner.pt is not this run's" in complaint(words, capsys)
    assert not mark.exists()


def test_networks_of_an_impossible_size_are_not_made(config: RunConfig, tmp_path: Path) -> None:
    folder = run_of(tmp_path / "run", config)
    huge = dataclasses.replace(config, agent=dataclasses.replace(config.agent, hidden=10**9))
    with pytest.raises(ConfigError, match=r"--hidden=1000000000: take a number from 1"):
        load_agent(folder, huge, "latest")


@pytest.mark.parametrize("state", [[], {}, {"agent": None}, {"agent": {}}, {"agent": {1: 2}}], ids=str)
def test_another_runs_state_is_said_to_be_so(config: RunConfig, tmp_path: Path, state: object) -> None:
    folder, file = run_of(tmp_path / "run", config), io.BytesIO()
    checkpoints = CheckpointFolder(folder.checkpoints)
    torch.save(state, file)
    checkpoints.save(8, {**checkpoints.load(7), "learner.pt": file.getvalue()})
    with pytest.raises(ConfigError, match=r"its learner\.pt is not this run's"):
        load_agent(folder, config, "latest")
