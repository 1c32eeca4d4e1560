"""A baseline's model and vector environment: made, saved whole, loaded again, played.

Imported only where the extra ``baselines`` is installed. Shapes: N environments, O observation, A action.
"""

import json
import math
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sb3_contrib import CrossQ, RecurrentPPO
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from rmc.analysis.baseline_settings import OFF_POLICY, BaselineConfig, Choice, choose
from rmc.common.env.config import EnvConfig
from rmc.common.env.make import make_env
from rmc.common.errors import ConfigError, first_line
from rmc.common.whole_file import write_whole
from rmc.common.window import BoolArray, Floats
from rmc.deploy.run.folder import RunFolder

CLASSES: dict[str, Any] = {
    "sac": SAC, "crossq": CrossQ, "td3": TD3, "ddpg": DDPG, "ppo": PPO, "recurrent-ppo": RecurrentPPO,
}  # fmt: skip
MODEL, BUFFER, SCALES, PROGRESS = "model.zip", "replay_buffer.pkl", "scales.pkl", "progress.json"


class BaselineModel:
    """What a run trains: as it was saved last, or new. Raises ConfigError where what was saved cannot be read."""

    def __init__(self, config: BaselineConfig, saved: Path | None) -> None:
        self._config = config
        choice = choose(config.algorithm, config.settings, config.env.id)
        vec: VecEnv = DummyVecEnv([lambda: Monitor(make_env(config.env))])
        if saved is not None:
            self.vec, self.sb3 = self._load(saved, vec, choice)
        else:
            gamma = float(choice.arguments.get("gamma", 0.99))
            self.vec = VecNormalize(vec, gamma=gamma) if choice.normalize else vec
            policy = "MlpLstmPolicy" if config.algorithm == "recurrent-ppo" else "MlpPolicy"
            arguments = self._arguments(choice)
            self.sb3 = CLASSES[config.algorithm](policy, self.vec, **arguments, seed=config.seed, device="cpu")

    @property
    def steps(self) -> int:
        """Agent steps so far."""
        return int(self.sb3.num_timesteps)

    @property
    def updates(self) -> int:
        """Gradient steps so far. On-policy ones count their epochs, each of several minibatches."""
        steps = 1
        if self._config.algorithm not in OFF_POLICY:
            steps = math.ceil(self.sb3.n_steps * self.sb3.n_envs / self.sb3.batch_size)
        return int(self.sb3._n_updates) * steps

    def _load(self, saved: Path, vec: VecEnv, choice: Choice) -> tuple[VecEnv, Any]:
        with reading(saved):
            vec = VecNormalize.load(str(saved / SCALES), vec) if choice.normalize else vec
            sb3 = CLASSES[self._config.algorithm].load(saved / MODEL, env=vec, device="cpu")
            if self._config.algorithm in OFF_POLICY:
                with (saved / BUFFER).open("rb") as file:
                    sb3.load_replay_buffer(file)
                _grow(sb3.replay_buffer, self._buffer_size)
        vec.seed(self._config.seed + sb3.num_timesteps)  # not the episodes that it has had
        return vec, sb3

    @property
    def _buffer_size(self) -> int:
        return min(1_000_000, self._config.total_steps)  # as large as it can ever be of use

    def _arguments(self, choice: Choice) -> dict[str, Any]:
        network = dict(choice.network) | ({"activation_fn": torch.nn.ReLU} if choice.relu else {})
        arguments = dict(choice.arguments) | ({"policy_kwargs": network} if network else {})
        if self._config.algorithm in OFF_POLICY:
            arguments["buffer_size"] = self._buffer_size
        if choice.noise:
            size = self.vec.action_space.shape or (1,)
            arguments["action_noise"] = NormalActionNoise(np.zeros(size), np.full(size, choice.noise))
        return arguments

    def save(self, folder: RunFolder) -> None:
        """Beside the last one, which goes once this is whole; its progress, written last, says that. Raises OSError."""
        at, before = folder.checkpoints / f"{self.steps:012d}", saved_states(folder)
        if before[-1:] == [at]:
            return
        try:
            self._write(at)
        except OSError:  # no room: what is there of it would take the last one's place on the disk
            shutil.rmtree(at, ignore_errors=True)
            raise
        for old in before:
            shutil.rmtree(old)

    def _write(self, at: Path) -> None:
        at.mkdir(exist_ok=True)
        self.sb3.save(at / MODEL)
        if self._config.algorithm in OFF_POLICY:
            self.sb3.save_replay_buffer(at / BUFFER)
        if isinstance(self.vec, VecNormalize):
            self.vec.save(str(at / SCALES))
        write_whole(at / PROGRESS, json.dumps({"env_steps": self.steps, "updates": self.updates}).encode())

    def player(self) -> "SB3Adapter":
        """It as it is now."""
        return SB3Adapter(self.sb3, _scaled_by(self.vec))

    def close(self) -> None:
        """Its environment."""
        self.vec.close()


class SB3Adapter:
    """A model as our evaluator plays an agent, in one environment; its memory, if it has one, is kept in here."""

    def __init__(self, model: Any, scaled: Callable[[Floats], Floats]) -> None:
        self._model, self._scaled = model, scaled
        self._state: Any = None
        self._begins = np.ones(1, np.bool_)

    def start(self) -> tuple[Floats, Floats]:
        """Previous actions (N, A), and in place of a state (N, 0), at the start of episodes."""
        self._state, self._begins = None, np.ones(1, np.bool_)
        sizes = (*self._model.action_space.shape, 0)
        actions, nothing = (np.zeros((1, size), np.float32) for size in sizes)
        return actions, nothing

    def act(
        self, observation: Floats, _prev_action: Floats, _missing: BoolArray, state: Floats, _: Floats | None
    ) -> tuple[Floats, Floats]:
        """(N, O) -> (N, A), as ``PolicyRunner.act``; of the rest nothing is used."""
        scaled = self._scaled(observation)
        action, self._state = self._model.predict(scaled, self._state, self._begins, deterministic=True)
        self._begins = np.zeros(1, np.bool_)
        return action.astype(np.float32), state


def saved_player(config: BaselineConfig, saved: Path, env: EnvConfig) -> SB3Adapter:
    """What was saved, to be played in ``env``. Raises ConfigError where it cannot be read."""
    with reading(saved), torch.random.fork_rng(devices=[]):
        unseeded = {"seed": None}  # the generators that all share are the caller's
        model = CLASSES[config.algorithm].load(saved / MODEL, device="cpu", custom_objects=unseeded)
        return SB3Adapter(model, _kept_scaling(saved / SCALES, env))


def saved_states(folder: RunFolder) -> list[Path]:
    """What can be gone on with, whole, oldest first."""
    return [path.parent for path in sorted(folder.checkpoints.glob(f"*/{PROGRESS}"))]


@contextmanager
def reading(saved: Path) -> Iterator[None]:
    """Raises ConfigError where a state is not as it was saved."""
    try:
        yield
    except Exception as error:  # zipfile, pickle and torch raise several unrelated classes
        fix = f"cannot be read ({first_line(error)}); restore it, or train another run"
        raise ConfigError("RUN", str(saved), fix) from None


def _grow(buffer: ReplayBuffer, size: int) -> None:
    """Room for so many steps, where it has less; what is in it stays."""
    if size <= buffer.buffer_size:
        return
    if buffer.full:
        buffer.pos, buffer.full = buffer.buffer_size, False
    for name, array in list(vars(buffer).items()):
        if isinstance(array, np.ndarray):
            more = np.zeros((size, *array.shape[1:]), array.dtype)
            more[: len(array)] = array
            setattr(buffer, name, more)
    buffer.buffer_size = size


def _kept_scaling(scales: Path, env: EnvConfig) -> Callable[[Floats], Floats]:
    """Observations as a model sees them that was saved with these, if with any."""
    if not scales.exists():
        return lambda observation: observation
    bare = DummyVecEnv([lambda: make_env(env)])
    try:
        return _scaled_by(VecNormalize.load(str(scales), bare))
    finally:
        bare.close()


def _scaled_by(vec: VecEnv) -> Callable[[Floats], Floats]:
    """Observations as a model sees them that was trained in this environment."""
    if isinstance(vec, VecNormalize):
        return lambda observation: np.asarray(vec.normalize_obs(observation), np.float32)
    return lambda observation: observation
