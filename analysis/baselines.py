"""``rmc baseline``: stable-baselines3's agents, trained on our environments and judged by our evaluator.

The run's folder looks like that of ``rmc train``, so that ``rmc plot`` reads both. Imported only where the extra
``baselines`` is installed. Shapes: N environments, O observation, A action.
"""

import dataclasses
import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from sb3_contrib import CrossQ, RecurrentPPO
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from rmc.actors.config import EvaluatorConfig
from rmc.actors.evaluator import Rollout, evaluation_metrics, first_start, play_episodes
from rmc.analysis.baseline_settings import OFF_POLICY, BaselineConfig, Choice, choose, read, validate
from rmc.analysis.evaluation import FINAL_EPISODES, EvaluationProgress, Watch, missing_shares
from rmc.common.env.config import EnvConfig
from rmc.common.env.make import env_layout, make_env
from rmc.common.env.wrappers import Floats
from rmc.common.errors import ConfigError, first_line
from rmc.common.process.role import StopSignal
from rmc.common.whole_file import write_whole
from rmc.deploy.run.config import changes, layout_sizes, option
from rmc.deploy.run.folder import RunFolder, read_object
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.metrics_tail import wall_seconds
from rmc.deploy.run.migrations import FORMAT
from rmc.deploy.run.opening import default_name, forget_start, has_more_than_a_start, make, new_folder
from rmc.deploy.run.starts import note_start, resume_command
from rmc.deploy.run.state import STOPPED

CLASSES: dict[str, Any] = {
    "sac": SAC, "crossq": CrossQ, "td3": TD3, "ddpg": DDPG, "ppo": PPO, "recurrent-ppo": RecurrentPPO,
}  # fmt: skip
MAY_CHANGE = {"total_steps", "threads", "checkpoint_steps", "episodes", "env.env_timeout"}
SAVE_SECONDS = 120.0  # between states that can be gone on with: a replay buffer is large
RECORD_SECONDS = 5.0
MODEL, BUFFER, SCALES, PROGRESS = "model.zip", "replay_buffer.pkl", "scales.pkl", "progress.json"


def train(config: BaselineConfig, run_dir: Path | None, console: Console, stop: StopSignal) -> int:
    """Train to the end, or to a stop signal; the exit status. Raises ConfigError before anything is written."""
    validate(config)
    sizes = _sizes(config)
    folder = _open_folder(config, run_dir, sizes)
    status = 1
    try:
        _set_torch(config)
        console.print(f"run folder {folder.path}", soft_wrap=True)
        status = _conduct(config, folder, console, stop)
    finally:
        folder.unlock(status)
    return status


def _set_torch(config: BaselineConfig) -> None:
    """What an action's last bits depend on, the same to train and to evaluate."""
    torch.set_num_threads(config.threads)
    torch.set_flush_denormal(True)  # as our learner does


def _conduct(config: BaselineConfig, folder: RunFolder, console: Console, stop: StopSignal) -> int:
    result, steps = None, 0
    with suppress(_Stopped), closing(_Run(config, folder, console, stop)) as run:
        run.train()
        steps = run.steps
        result = None if stop.requested else run.result()
    if result is None:
        console.print(f"stopped at environment step {steps:,}; to go on:")
        console.print(f"  {resume_command(folder)}", soft_wrap=True)
        return STOPPED
    folder.write_result(result)
    mean, deviation = result["eval_return_mean"], result["eval_return_std"]
    console.print(f"after training: return {mean:,.1f} ± {deviation:,.1f}; {folder.result_file}")
    return 0


def _sizes(config: BaselineConfig) -> dict[str, Any]:
    """What its networks are made for. Raises ConfigError."""
    return layout_sizes(env_layout(config.env))


def _open_folder(config: BaselineConfig, run_dir: Path | None, sizes: dict[str, Any]) -> RunFolder:
    """Make or take up a run's folder, locked, as ``open_run``. Raises ConfigError."""
    name = default_name(config.env.id, f"{config.algorithm}-{config.settings}", config.seed)
    folder = RunFolder(run_dir) if run_dir is not None else new_folder(Path("runs").resolve() / name)
    there = (folder.path / "config.json").exists() and folder.is_baseline()
    before = read(folder) if there else config
    changed = changes(before, config)
    if refused := next((path for path in changed if path not in MAY_CHANGE), None):
        was, now = changed[refused]
        fix = f"the run in {folder.path} has {was!r}; use that, or another --run-dir"
        raise ConfigError("ENV" if refused == "env.id" else option(refused), now, fix)
    if there:
        folder.check_sizes(config.env.id, sizes)
    elif has_more_than_a_start(folder):
        raise ConfigError("--run-dir", str(folder.path), "is there and is no baseline's; give another one")
    make(folder)
    folder.lock()
    if not there:
        forget_start(folder)
    folder.reopen(config.total_steps)
    note_start(folder, changed, LaunchOptions(folder.path), None)
    written = json.dumps({"format": FORMAT} | asdict(config), indent=2)
    write_whole(folder.path / "config.json", f"{written}\n".encode())
    folder.write_sizes(sizes)
    for leftover in set(folder.checkpoints.glob("[0-9]*")) - set(_states(folder)):  # by a crash amid a save
        shutil.rmtree(leftover)
    return folder


def _states(folder: RunFolder) -> list[Path]:
    """What can be gone on with, whole, oldest first."""
    return [path.parent for path in sorted(folder.checkpoints.glob(f"*/{PROGRESS}"))]


@contextmanager
def _reading(state: Path) -> Iterator[None]:
    """Raises ConfigError where a state is not as it was saved."""
    try:
        yield
    except Exception as error:  # zipfile, pickle and torch raise several unrelated classes
        fix = f"cannot be read ({first_line(error)}); restore it, or train another run"
        raise ConfigError("RUN", str(state), fix) from None


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
        self, observation: Floats, _prev_action: Floats, _missing: NDArray[np.bool_], state: Floats, _: Floats | None
    ) -> tuple[Floats, Floats]:
        """(N, O) -> (N, A), as ``PolicyRunner.act``; of the rest nothing is used."""
        scaled = self._scaled(observation)
        action, self._state = self._model.predict(scaled, self._state, self._begins, deterministic=True)
        self._begins = np.zeros(1, np.bool_)
        return action.astype(np.float32), state


class _Stopped(Exception):
    """Amid an evaluation, by the signal."""


class _Run(BaseCallback):
    """A model between its environment and its folder: evaluates, records, saves, stops. Raises _Stopped."""

    def __init__(self, config: BaselineConfig, folder: RunFolder, console: Console, stop: StopSignal) -> None:
        super().__init__()
        self.config, self.folder, self._console, self._stop = config, folder, console, stop
        choice = choose(config.algorithm, config.settings, config.env.id)
        self._vec, self._model = self._load(choice)
        self._began, self._wall_before = time.monotonic(), wall_seconds(folder.metrics)
        self._save_at, self._record_at = time.monotonic() + SAVE_SECONDS, 0.0
        self._next_evaluation = self._after(self.steps)
        self._initial = self._first_evaluation()
        self._metrics = folder.metrics.open("a", buffering=1)

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self._model.num_timesteps)

    @property
    def updates(self) -> int:
        """Gradient steps so far."""
        return int(self._model._n_updates)

    # -- the model --------------------------------------------------------------------------------------

    def _load(self, choice: Choice) -> tuple[VecEnv, Any]:
        """As it was saved last, or new."""
        config, at, kind = self.config, _states(self.folder)[-1:], CLASSES[self.config.algorithm]
        vec: VecEnv = DummyVecEnv([lambda: Monitor(make_env(config.env))])
        if at:
            with _reading(at[0]):
                vec = VecNormalize.load(str(at[0] / SCALES), vec) if choice.normalize else vec
                model = kind.load(at[0] / MODEL, env=vec, device="cpu")
                if config.algorithm in OFF_POLICY:
                    with (at[0] / BUFFER).open("rb") as file:
                        model.load_replay_buffer(file)
                    _grow(model.replay_buffer, self._buffer_size)
            vec.seed(config.seed + model.num_timesteps)  # not the episodes that it has had
            return vec, model
        if choice.normalize:
            vec = VecNormalize(vec, gamma=float(choice.arguments.get("gamma", 0.99)))
        return vec, kind(_policy(config), vec, **self._arguments(choice, vec), seed=config.seed, device="cpu")

    @property
    def _buffer_size(self) -> int:
        return min(1_000_000, self.config.total_steps)  # as large as it can ever be of use

    def _arguments(self, choice: Choice, vec: VecEnv) -> dict[str, Any]:
        network = dict(choice.network) | ({"activation_fn": torch.nn.ReLU} if choice.relu else {})
        arguments = dict(choice.arguments) | ({"policy_kwargs": network} if network else {})
        if self.config.algorithm in OFF_POLICY:
            arguments["buffer_size"] = self._buffer_size
        if choice.noise:
            size = vec.action_space.shape or (1,)
            arguments["action_noise"] = NormalActionNoise(np.zeros(size), np.full(size, choice.noise))
        return arguments

    def _save(self) -> None:
        """Beside the last one, which goes once this is whole; its progress, written last, says that."""
        at, before = self.folder.checkpoints / f"{self.steps:012d}", _states(self.folder)
        if before[-1:] == [at]:
            return
        at.mkdir(exist_ok=True)
        self._model.save(at / MODEL)
        if self.config.algorithm in OFF_POLICY:
            self._model.save_replay_buffer(at / BUFFER)
        if isinstance(self._vec, VecNormalize):
            self._vec.save(str(at / SCALES))
        write_whole(at / PROGRESS, json.dumps({"env_steps": self.steps, "updates": self.updates}).encode())
        for old in before:
            shutil.rmtree(old)
        self._save_at = time.monotonic() + SAVE_SECONDS

    # -- training ---------------------------------------------------------------------------------------

    def train(self) -> None:
        """To the end or the signal; what is not saved then is saved."""
        missing = self.config.total_steps - self.steps
        if missing > 0:
            with suppress(_Stopped):
                self._model.learn(missing, self, reset_num_timesteps=False, log_interval=None)
        self._save()
        self._write_progress()

    def close(self) -> None:
        self._metrics.close()
        self._vec.close()

    def _on_step(self) -> bool:
        now = time.monotonic()
        if now >= self._record_at:
            self._record_at = now + RECORD_SECONDS
            self._write_progress()
        if self.num_timesteps >= self._next_evaluation:
            self._next_evaluation = self._after(self.num_timesteps)
            self._evaluate()
            if now >= self._save_at:
                self._save()
        return not self._stop.requested

    def _after(self, steps: int) -> int:
        return (steps // self.config.checkpoint_steps + 1) * self.config.checkpoint_steps

    # -- evaluation and records -------------------------------------------------------------------------

    def _play(self, episodes: int, final: bool) -> dict[str, Any]:
        adapter, seed = SB3Adapter(self._model, _scaled_by(self._vec)), first_start(self.config.seed, final)
        progress = EvaluationProgress(self._console, f"evaluation at step {self.steps:,}")

        def watch(rollout: Rollout) -> None:
            progress(rollout)
            if self._stop.requested:
                raise _Stopped

        seconds = EvaluatorConfig.evaluation_seconds
        return evaluation_metrics(
            play_episodes(adapter, lambda: make_env(self.config.env), episodes, seed, seconds, watch)
        )

    def _first_evaluation(self) -> float:
        """Of what it was before any training, once for the folder."""
        initial = self.folder.path / "initial.json"
        if not initial.exists():
            write_whole(initial, json.dumps(self._play(FINAL_EPISODES, final=True)).encode())
        return float(read_object(initial, "eval_return_mean")["eval_return_mean"])

    def _evaluate(self) -> None:
        result = self._play(self.config.episodes, final=False)
        self._write_progress()
        self._write("evaluator", {**result, "eval_update": self.updates, "eval_env_steps": self.steps})
        mean, deviation = result["eval_return_mean"], result["eval_return_std"]
        line = f"environment step {self.steps:,}: return {mean:,.1f} ± {deviation:,.1f}, {self._wall():,.0f} s"
        self._console.print(line)

    def _write_progress(self) -> None:
        self._write("launcher", {"wall_s": self._wall()})
        self._write("learner", {"env_steps": self.steps, "updates": self.updates})

    def _write(self, role: str, record: dict[str, Any]) -> None:
        self._metrics.write(json.dumps({"role": role, "time": time.time(), **record}) + "\n")

    def _wall(self) -> float:
        return self._wall_before + time.monotonic() - self._began

    def result(self) -> dict[str, Any]:
        """As that of ``rmc train``."""
        wall_s = self._wall()
        return {
            "env": self.config.env.id,
            "preset": self.config.name,
            "seed": self.config.seed,
            "env_steps": self.steps,
            "updates": self.updates,
            **self._play(FINAL_EPISODES, final=True),
            **missing_shares(self.config.env),
            "initial_return_mean": self._initial,
            "wall_s": wall_s,
        }


def evaluate(
    folder: RunFolder,
    episodes: int,
    flicker: float | None = None,
    seconds: float = 0.0,
    watch: Watch = lambda _: None,
    env_timeout: float | None = None,
) -> dict[str, Any]:
    """Deterministic episodes of what a baseline's run saved last, as ``evaluate_policy``. Raises ConfigError."""
    config, states = read(folder), _states(folder)
    if not states:
        raise ConfigError("RUN", str(folder.path), "it has no checkpoint yet; train it for longer")
    folder.check_sizes(config.env.id, _sizes(config))
    _set_torch(config)
    progress = read_object(states[-1] / PROGRESS, "env_steps", "updates")
    env = config.env if flicker is None else dataclasses.replace(config.env, flicker=flicker)
    env = env if env_timeout is None else dataclasses.replace(env, env_timeout=env_timeout)
    with _reading(states[-1]):
        model = CLASSES[config.algorithm].load(states[-1] / MODEL, device="cpu")
        scaled = _kept_scaling(states[-1] / SCALES, env)
    seed = first_start(config.seed, final=True)
    rollout = play_episodes(SB3Adapter(model, scaled), lambda: make_env(env), episodes, seed, seconds, watch)
    about = {"env": env.id, "preset": config.name, "seed": config.seed, **progress}
    return about | evaluation_metrics(rollout) | missing_shares(env)


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


def _policy(config: BaselineConfig) -> str:
    return "MlpLstmPolicy" if config.algorithm == "recurrent-ppo" else "MlpPolicy"
