"""One training of a baseline, from its environment to its folder: it evaluates, records, saves and stops."""

import math
import time
from contextlib import closing, suppress
from typing import Any

import torch
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback

from rmc.actors.config import EvaluatorConfig
from rmc.actors.evaluator import Rollout, evaluation_record, first_start, play_episodes
from rmc.analysis.baseline_model import BaselineModel
from rmc.analysis.baseline_settings import OFF_POLICY, BaselineConfig
from rmc.analysis.evaluation import FINAL_EPISODES, EvaluationProgress, missing_shares
from rmc.common.env.make import make_env
from rmc.common.process.role import StopSignal
from rmc.common.return_text import return_text
from rmc.common.whole_file import NO_ROOM
from rmc.deploy.monitor import main_metrics
from rmc.deploy.monitor.metrics_log import MetricsLog
from rmc.deploy.run.folder import ROOM_SECONDS, RunFolder, read_object
from rmc.deploy.run.metrics_tail import MetricsTail, wall_seconds
from rmc.deploy.run.option_names import flat
from rmc.learner.precision import has_fast_bf16

SAVE_SECONDS = 120.0  # between states that can be gone on with: a replay buffer is large
RECORD_SECONDS = 5.0


class Stopped(Exception):
    """Amid an evaluation, by the signal."""


class BaselineRun(BaseCallback):
    """A model between its environment and its folder: evaluates, records, saves, stops. Raises Stopped."""

    def __init__(
        self, config: BaselineConfig, folder: RunFolder, model: BaselineModel, console: Console, stop: StopSignal
    ) -> None:
        super().__init__()
        self.config, self.folder, self._console, self._stop = config, folder, console, stop
        self._model = model
        rounds = config.precision == "auto" and config.algorithm in OFF_POLICY  # on-policy ones gain nothing
        self._update_precision = "medium" if rounds and has_fast_bf16(torch.device("cpu")) else "highest"
        self._full = False  # the disk, when it was saved last
        self._record_at = math.inf
        self._next_evaluation = self._after(min(self.steps, evaluated_steps(folder)))  # one that was cut is made up
        self._initial = self._first_evaluation()  # no training time
        self._began, self._wall_before = time.monotonic(), wall_seconds(folder.metrics)
        self._save_at = self._began + SAVE_SECONDS
        self._metrics, self._record_at = MetricsLog(folder, flat(config)), 0.0

    @property
    def steps(self) -> int:
        """Agent steps so far."""
        return self._model.steps

    # Training

    def train(self) -> None:
        """To the end or the signal; what is not saved then is saved."""
        missing = self.config.total_steps - self.steps
        if missing > 0:
            with suppress(Stopped):
                self._model.sb3.learn(missing, self, reset_num_timesteps=False, log_interval=None)
        while not self._saved() and not self._stop.requested:
            time.sleep(ROOM_SECONDS)
        self._write_progress(finished=self.steps >= self.config.total_steps)
        self._record_at = math.inf  # the last evaluation is no training time

    def close(self) -> None:
        self._metrics.close()

    def _on_rollout_start(self) -> None:
        torch.set_float32_matmul_precision("highest")  # what acts, and is evaluated, rounds nothing

    def _on_rollout_end(self) -> None:
        torch.set_float32_matmul_precision(self._update_precision)  # medium: products of bfloat16, as our learner's

    def _on_training_end(self) -> None:
        self._on_rollout_start()

    def _on_step(self) -> bool:
        now = time.monotonic()
        self._speak()
        if self.num_timesteps >= self._next_evaluation:
            self._next_evaluation = self._after(self.num_timesteps)
            self._evaluate()
            if now >= self._save_at and self._saved():
                self._save_at = time.monotonic() + SAVE_SECONDS
        return not self._stop.requested

    def _saved(self) -> bool:
        """Save; whether there was room. It is said once where there was none."""
        try:
            self._model.save(self.folder)
        except OSError as error:
            if error.errno not in NO_ROOM:
                raise
            if not self._full:
                self._console.print(f"{self.folder.checkpoints} finds no room; make some", soft_wrap=True)
            self._full = True
            return False
        self._full = False
        return True

    def _after(self, steps: int) -> int:
        return (steps // self.config.checkpoint_steps + 1) * self.config.checkpoint_steps

    # Evaluation and records

    def _play(self, episodes: int, final: bool, model: BaselineModel | None = None) -> dict[str, Any]:
        player, seed = (model or self._model).player(), first_start(self.config.seed, final)
        progress = EvaluationProgress(self._console, f"evaluation at step {self.steps:,}")

        def watch(rollout: Rollout) -> None:
            progress(rollout)
            self._speak()
            if self._stop.requested:
                raise Stopped

        seconds = EvaluatorConfig.evaluation_seconds
        return evaluation_record(
            play_episodes(player, lambda: make_env(self.config.env), episodes, seed, seconds, watch)
        )

    def _first_evaluation(self) -> float:
        """Of what it was before any training, once for the folder."""
        if (kept := initial_return(self.folder)) is not None:
            return kept
        if self.steps == 0:
            played = self._play(FINAL_EPISODES, final=True)
        else:  # that file was removed since
            with closing(BaselineModel(self.config, None)) as new:
                played = self._play(FINAL_EPISODES, final=True, model=new)
        self.folder.write_initial(played)
        return float(played["eval_return_mean"])

    def _evaluate(self) -> None:
        result = self._play(self.config.episodes, final=False)
        self._write_progress()
        self._write("evaluator", {**result, "eval_update": self._model.updates, "eval_env_steps": self.steps})
        returns = return_text(result["eval_return_mean"], result["eval_return_std"])
        self._console.print(f"step {self.steps:,}: return {returns}, {self._wall():,.0f} s")

    def _speak(self) -> None:
        """Say now and then how far it is: who says nothing for long is taken for hanging."""
        now = time.monotonic()
        if now >= self._record_at:
            self._record_at = now + RECORD_SECONDS
            self._write_progress()

    def _write_progress(self, finished: bool = False) -> None:
        self._write("launcher", {"wall_s": self._wall()})
        self._write("learner", {"env_steps": self.steps, "updates": self._model.updates, "finished": int(finished)})

    def _write(self, role: str, record: dict[str, Any]) -> None:
        record = {"role": role, "time": time.time(), **record}
        self._metrics.write(record, self.steps, main_metrics.evaluation_metrics(record))

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
            "updates": self._model.updates,
            **self._play(FINAL_EPISODES, final=True),
            **missing_shares(self.config.env),
            "initial_return_mean": self._initial,
            "wall_s": wall_s,
        }


def initial_return(folder: RunFolder) -> float | None:
    """Of what it was before any training, if that was played. Raises ConfigError where the file is damaged."""
    file = folder.initial_file
    return float(read_object(file, "eval_return_mean")["eval_return_mean"]) if file.exists() else None


def evaluated_steps(folder: RunFolder) -> int:
    """Agent steps at the last evaluation; 0 before the first."""
    said = (record.get("eval_env_steps") for record in MetricsTail(folder.metrics).take())
    return max((steps for steps in said if isinstance(steps, int)), default=0)
