"""``rmc inspect``: what a run's world model knows, along one episode, and what it remembers, as a picture and numbers.

Shapes: T steps of the episode, O observation, A action, H hidden, M flags of what is missing, K steps ahead.
Observations are normalised ones.
"""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
import torch
from torch import Tensor

from rmc.analysis import memory_picture
from rmc.analysis.episodes import Episode, Player, unroll_episode
from rmc.analysis.memory_picture import MemoryInsight, examine_memory
from rmc.analysis.out_file import PICTURES, check_writable
from rmc.analysis.value_bias import ValueBias, value_bias
from rmc.common.agent import Agent, MemoryOutput, initial_agent
from rmc.common.checkpoint import STATE
from rmc.common.errors import ConfigError, first_line
from rmc.common.extra import check_installed
from rmc.common.window import Floats
from rmc.deploy.run.checkpoint_choice import choose_checkpoint
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.validation import validate
from rmc.learner.diagnostics import relative_l1_error
from rmc.learner.learner_checkpoint import NOT_OURS, read_state
from rmc.learner.losses import model_error

HORIZONS = (1, 5, 15)  # steps ahead
SHOWN, SHOWN_STEPS = 4, 100  # dimensions in the picture, those that change the most, and from when on how long
NOTHING_SEEN = "no change was seen from one step to the next; the world model is not judged by it"


@dataclass(frozen=True)
class Insight:
    """What the world model says of an episode."""

    real: Floats  # (T, O), the next observations, NaN where they are missing
    curiosity: Floats  # (T,), the world model's error of the online memory's change
    reward: Floats  # (T,)
    predicted_reward: Floats  # (T,)
    ahead: dict[int, Floats]  # horizon K -> (T - K + 1, O), predicted without looking, K steps ahead
    unexplained: Floats  # (O,), error of the change as a share of its size; above 1 is worse than "no change"
    open_loop: dict[int, float]  # horizon -> the same over all dimensions


def load_agent(folder: RunFolder, config: RunConfig, checkpoint: str) -> Agent:
    """The whole agent of a checkpoint, with its world model. Raises ConfigError."""
    validate(config)
    spec = config.window_spec()
    folder.check_sizes(config.env.id, config.sizes())
    agent = Agent(spec.obs_dim, spec.action_dim, config.agent, spec.missing, spec.privileged)
    number, files = choose_checkpoint(folder, checkpoint)
    try:
        agent.load_state_dict(read_state(files, torch.device("cpu"))["agent"])
        if not all(value.isfinite().all() for value in agent.state_dict().values()):
            raise ValueError("it is not finite")
    except NOT_OURS as error:
        fix = f"its {STATE} is not this run's ({first_line(error)}); use another"
        raise ConfigError("--checkpoint", str(number), fix) from None
    return agent.eval()


@torch.no_grad()
def look(agent: Agent, episode: Episode, norm: Literal["l1", "l2"] = "l1", reward_scale: float = 1.0) -> Insight:
    """Everything from one pass over the episode, and open-loop rollouts from each of its steps.

    ``norm`` is that of the world model's error. Rewards are told as the environment gives them.
    """
    memory, seen = unroll_episode(agent, episode)
    prediction = agent.world_model(agent.features(memory)[:, :-1], episode.action)
    latent_change = memory.hidden[0].diff(dim=0)
    real = episode.observation[0, 1:].masked_fill(episode.missing[0, 1:], torch.nan)
    ahead = _open_loop(agent, memory, seen[0, :-1], episode.action[0])
    return Insight(
        real=real.numpy(),
        curiosity=model_error(prediction.hidden_change[0], latent_change, norm).numpy(),
        reward=(episode.reward / reward_scale).numpy(),
        predicted_reward=(prediction.reward[0] / reward_scale).numpy(),
        ahead={horizon: predicted.numpy() for horizon, predicted in ahead.items()},
        unexplained=relative_l1_error(*_error(ahead[1], episode, 1)).numpy(),
        open_loop=_open_loop_errors(ahead, episode),
    )


def _open_loop(agent: Agent, memory: MemoryOutput, observation: Tensor, action: Tensor) -> dict[int, Tensor]:
    """Horizon K -> (T - K + 1, O): from every step on, the model's own states and observations in place of the real.

    Observations (T, O) to start from, actions (T, A).
    """
    hidden = memory.hidden[0, :-1]
    steps, predicted = len(action), {}
    for ahead in range(1, min(max(HORIZONS), steps) + 1):
        count = steps - ahead + 1  # starts from which so many steps were played
        hidden, observation, a = hidden[:count], observation[:count], action[ahead - 1 :]
        step = agent.world_model(agent.features(MemoryOutput(hidden, agent.memory.skip(observation))), a)
        hidden, observation = hidden + step.hidden_change, observation + step.observation_change
        if ahead in HORIZONS:
            predicted[ahead] = observation
    return predicted


def _open_loop_errors(ahead: dict[int, Tensor], episode: Episode) -> dict[int, float]:
    """By horizon, over all dimensions; a horizon of which nothing was seen at both ends is left out."""
    errors = {horizon: _error(predicted, episode, horizon) for horizon, predicted in ahead.items()}
    sums = {horizon: (float(error.sum()), float(size.sum())) for horizon, (error, size) in errors.items()}
    return {horizon: error / size for horizon, (error, size) in sums.items() if size > 0.0}


def _error(predicted: Tensor, episode: Episode, horizon: int) -> tuple[Tensor, Tensor]:
    """(O,) sums of |predicted - real| and of |real - where it started|, where both frames were seen."""
    observation = episode.observation[0]
    start, end = observation[: len(predicted)], observation[horizon:]
    seen = episode.seen[: len(predicted)] & episode.seen[horizon - 1 :]
    return ((predicted - end).abs() * seen).sum(0), ((end - start).abs() * seen).sum(0)


def inspect(run: Path, checkpoint: str, out: Path) -> tuple[Insight, MemoryInsight, ValueBias | None]:
    """Play several episodes, look at the first, and write the picture with what is remembered. Raises ConfigError."""
    check_installed("plot", ("matplotlib",), "--out", str(out))
    check_writable("--out", out, PICTURES)
    folder = RunFolder(run)
    config, agent = _grounded(folder, checkpoint)
    with closing(Player(agent, config)) as player:
        episodes, hidden = player.several(), player.hidden_parts()
    scale = config.actor.reward_scale
    insight = look(agent, episodes[0], config.update.model_norm, scale)
    untrained = initial_agent(config.window_spec(), config.agent, config.seed).memory
    memory = examine_memory(agent, untrained, episodes, hidden)
    draw(insight, _title(config), out, memory)
    value = value_bias(agent, episodes, config.update.gamma, scale) if config.update.n_step == 1 else None
    return insight, memory, value


def inspect_to(folder: RunFolder, checkpoint: str, out: BinaryIO) -> Insight:
    """Play one episode, look, and write the picture as PNG to what is like a file. Raises ConfigError."""
    config, agent = _grounded(folder, checkpoint)
    with closing(Player(agent, config)) as player:
        insight = look(agent, player.play(), config.update.model_norm, config.actor.reward_scale)
    draw(insight, _title(config), out)
    return insight


def _grounded(folder: RunFolder, checkpoint: str) -> tuple[RunConfig, Agent]:
    config = folder.config()
    if not config.agent.grounding:
        fix = "its world model predicts no observations; train with --grounding"
        raise ConfigError("RUN", str(folder.path), fix)
    return config, load_agent(folder, config, checkpoint)


def _title(config: RunConfig) -> str:
    return f"{config.env.id}, {config.preset}, seed {config.seed}"


def draw(insight: Insight, title: str, out: Path | BinaryIO, memory: MemoryInsight | None = None) -> None:
    """Predicted against real amid the episode, curiosity and reward over all of it; then what is remembered."""
    from matplotlib.figure import Figure  # an extra

    change = np.diff(insight.real, axis=0, prepend=insight.real[:1])  # of one step alone, too
    shown = np.argsort(-np.nan_to_num(np.abs(change)).mean(0))[:SHOWN]
    count = len(shown) + 2 + (memory.panels if memory is not None else 0)
    figure = Figure(figsize=(11, 2.0 * count), layout="constrained")
    every = list(figure.subplots(count, 1))
    axes = every[: len(shown) + 2]
    if memory is not None:
        memory_picture.draw(memory, every[len(shown) + 2 :])
    time = np.arange(1, len(insight.real) + 1)
    start = max(1, (len(time) - SHOWN_STEPS) // 2)
    for axis, dimension in zip(axes, shown, strict=False):
        axis.plot(time, insight.real[:, dimension], "k.-", linewidth=2.0, markersize=4.0, label="real")
        for horizon, predicted in insight.ahead.items():
            label = f"{horizon} step{'s' * (horizon > 1)} ahead"
            axis.plot(time[horizon - 1 :], predicted[:, dimension], linewidth=1.0, label=label)
        axis.set_xlim(start, max(start + 1, min(start + SHOWN_STEPS, len(time))))
        axis.set_ylabel(f"observation {dimension}")
    axes[-2].plot(time, insight.curiosity, color="tab:purple", linewidth=0.8)
    axes[-2].set_ylabel("curiosity")
    axes[-1].plot(time, insight.reward, color="black", linewidth=1.2, label="real")
    axes[-1].plot(time, insight.predicted_reward, color="tab:blue", linewidth=0.8, label="predicted")
    axes[-1].set_ylabel("reward")
    axes[-1].set_xlabel("step of the episode")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(insight.ahead) + 1)
    figure.suptitle(f"{title}: the world model against one episode (observations normalised)", parse_math=False)
    figure.savefig(out, dpi=110)
