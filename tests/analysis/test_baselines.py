"""Agents of stable-baselines3 in runs of our own format: trained, stopped, gone on with, judged by our evaluator."""

import dataclasses
import errno
import json
import pickle
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from rmc import api
from rmc.analysis import baseline_run, baseline_settings, baselines
from rmc.analysis.baseline_model import BaselineModel
from rmc.analysis.baseline_settings import Algorithm, BaselineConfig, Settings, choose, read_config
from rmc.analysis.baselines import evaluate, train
from rmc.analysis.history import of_run
from rmc.cli.main import run as rmc
from rmc.common.env.config import EnvConfig
from rmc.common.env.process_state import _random_state
from rmc.common.errors import ConfigError
from rmc.common.process.role import StopSignal
from rmc.deploy.monitor.recorded import recorded_status
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.metrics_tail import wall_seconds
from rmc.deploy.run.migrations import FORMAT
from rmc.deploy.run.starts import note_start, starts
from tests import habits
from tests.command import COMMAND
from tests.raising import raising

ENV = EnvConfig("InvertedPendulum-v5")
ALGORITHMS = get_args(Algorithm)
TRAINED_BELOW = "sac", "td3", "ppo"  # and gone on with


@pytest.fixture(autouse=True, scope="module")
def small_networks() -> Iterator[None]:
    """Of the settings ``paper``: an update of theirs takes 23 ms."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(baseline_settings, "PAPER_NET", [16, 16])
        yield


def config(algorithm: Algorithm = "sac", settings: Settings = "paper", **other) -> BaselineConfig:
    return BaselineConfig(
        algorithm, **{"env": ENV, "total_steps": 300, "checkpoint_steps": 100, **other}, settings=settings
    )


def run(settings: BaselineConfig, folder, stop: StopSignal | None = None) -> int:
    return train(settings, folder, Console(quiet=True), stop or StopSignal())


@pytest.fixture(scope="module")
def finished(small_networks, tmp_path_factory) -> Path:
    """A run that is over; nobody changes it."""
    folder = tmp_path_factory.mktemp("sac") / "run"
    assert run(config(total_steps=200), folder) == 0
    return folder


ZOO = config("ppo", "zoo", env=EnvConfig("Hopper-v5"), total_steps=600, checkpoint_steps=300)


@pytest.fixture(scope="module")
def zoo(tmp_path_factory) -> Path:
    """The same of the zoo's PPO."""
    folder = tmp_path_factory.mktemp("zoo") / "run"
    assert run(ZOO, folder) == 0
    return folder


@pytest.mark.parametrize(
    "algorithm", [pytest.param(one, marks=[pytest.mark.long] * (one in TRAINED_BELOW)) for one in ALGORITHMS]
)
def test_every_one_trains_stops_and_goes_on(algorithm, tmp_path):
    folder = tmp_path / "run"
    assert run(config(algorithm), folder) == 0
    first = of_run(RunFolder(folder))
    assert first.finished
    assert first.env_steps >= 300
    assert [one.env_steps // 100 for one in first.evaluations][:2] == [1, 2]
    more = first.env_steps + 200  # a PPO's rollout may have gone past its end
    stop = StopSignal()
    stop.requested = True
    assert run(config(algorithm, total_steps=more), folder, stop) == 130
    assert not of_run(RunFolder(folder)).finished
    assert run(config(algorithm, total_steps=more), folder) == 0
    buffers = list((folder / "checkpoints").glob("*/replay_buffer.pkl"))
    assert bool(buffers) == (algorithm not in ("ppo", "recurrent-ppo"))
    for path in buffers:
        buffer = pickle.loads(path.read_bytes())
        assert (buffer.size(), len(buffer.rewards)) == (more - 1, more)  # all but the step that the signal ended
        assert buffer.observations[: more - 1].any(axis=(1, 2)).all()
    second = of_run(RunFolder(folder))
    assert second.env_steps >= more
    assert second.evaluations[: len(first.evaluations) - 1] == first.evaluations[:-1]
    assert second.initial_return == first.initial_return
    assert second.wall_s > first.wall_s
    assert second.updates >= first.updates


def test_its_last_evaluation_is_no_training_time(tmp_path, monkeypatch):
    played, scores = [], {"eval_return_mean": 1.0, "eval_return_std": 0.0, "eval_episodes": 1}
    monkeypatch.setattr(baseline_run.BaselineRun, "_play", lambda *_, **__: played.append(1) or scores)
    monkeypatch.setattr(baseline_run.BaselineRun, "_wall", lambda _: float(len(played)))
    assert run(config(), tmp_path / "run") == 0
    assert RunFolder(tmp_path / "run").result()["wall_s"] == len(played) - 1


def test_it_speaks_while_it_plays(tmp_path, monkeypatch):
    monkeypatch.setattr(baseline_run, "RECORD_SECONDS", 0.0)
    assert run(config(), tmp_path / "run") == 0
    folder = RunFolder(tmp_path / "run")
    records = list(folder.records())
    roles = [record["role"] for record in records if record["role"] != "learner"]
    assert roles.index("evaluator") > 101 + 20  # it comes at step 101
    assert [record["finished"] for record in records if record["role"] == "learner"][-2:] == [0, 1]
    result = folder.result()
    assert result is not None
    assert wall_seconds(folder.metrics) <= result["wall_s"]  # without the last evaluation


@pytest.mark.parametrize(
    ("algorithm", "precision", "fast", "rounded"),
    [
        ("sac", "auto", True, "medium"), ("td3", "auto", True, "medium"), ("sac", "auto", False, "highest"),
        ("sac", "fp32", True, "highest"), ("ppo", "auto", True, "highest"),
    ],
)  # fmt: skip
def test_only_an_update_rounds_its_products(algorithm, precision, fast, rounded, tmp_path, monkeypatch):
    seen = {"train": set(), "play": set()}

    class Watched(baselines.BaselineModel):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            train = self.sb3.train
            self.sb3.train = lambda *arguments, **named: note("train") or train(*arguments, **named)

        def player(self):
            note("play")
            return super().player()

    def note(kind):
        seen[kind].add(torch.get_float32_matmul_precision())

    monkeypatch.setattr(baselines, "BaselineModel", Watched)
    monkeypatch.setattr(baseline_run, "has_fast_bf16", lambda _: fast)
    assert run(config(algorithm, precision=precision), tmp_path / "run") == 0
    assert seen == {"train": {rounded}, "play": {"highest"}}
    assert torch.get_float32_matmul_precision() == "highest"


def test_tensorboard_draws_its_evaluations(finished):
    events = EventAccumulator(str(finished)).Reload().Scalars("Main/evaluation_return")
    records = [record for record in RunFolder(finished).records() if record["role"] == "evaluator"]
    assert [event.step for event in events] == [record["eval_env_steps"] for record in records] == [100, 200]
    assert [event.value for event in events] == pytest.approx([record["eval_return_mean"] for record in records])


def test_its_last_state_is_played_by_rmc_evaluate(zoo, capsys):
    torch.set_num_threads(2)  # as a process has it that has trained nothing
    assert rmc(["evaluate", str(zoo), "--episodes", "10", "--flicker", "0", "1", "--json"]) == 0
    assert torch.get_num_threads() == 1
    seen, blind = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    result = RunFolder(zoo).result()
    assert seen["eval_return_mean"] == result["eval_return_mean"]
    assert (blind["eval_flicker"], blind["env_steps"]) == (1.0, result["env_steps"])
    assert rmc(["evaluate", str(zoo), "--checkpoint", "best"]) == 2
    before = _random_state(), torch.get_rng_state().tolist()
    assert api.evaluate(zoo, flicker=0.0)["eval_return_mean"] == result["eval_return_mean"]
    assert (_random_state(), torch.get_rng_state().tolist()) == before  # the caller's generators are left alone
    with pytest.raises(ConfigError, match="a baseline keeps its last state only"):
        api.evaluate(zoo, checkpoint="best")
    with pytest.raises(ConfigError, match="is a baseline's run; only rmc evaluate"):
        api.resume(zoo)


class StopOnce(StopSignal):
    """Requested from when on a file is there."""

    def __init__(self, path: Path):
        self._path = path

    @property
    def requested(self) -> bool:
        return self._path.exists()


def test_a_stop_signal_is_heard_and_nothing_is_lost(tmp_path):
    stop, folder = StopSignal(), tmp_path / "run"
    stop.requested = True
    assert run(config(), folder, stop) == 130  # amid the first evaluation
    assert not (folder / "initial.json").exists()
    assert run(config(), folder, StopOnce(folder / "initial.json")) == 130
    assert RunFolder(folder).result() is None
    (state,) = (folder / "checkpoints").iterdir()
    assert json.loads((state / "progress.json").read_text())["env_steps"] == 1
    (folder / "checkpoints" / "999999").mkdir()  # one that a crash left without its progress
    assert run(config(), folder) == 0
    assert of_run(RunFolder(folder)).env_steps == 300
    assert [path.name for path in (folder / "checkpoints").iterdir()] == ["000000000300"]


def test_rmc_resume_goes_on_with_it(tmp_path, capsys):
    """The command that a stopped one prints; what is not said is as it was, also of an older version's run."""
    folder = tmp_path / "run"
    stop = StopOnce(folder / "initial.json")
    settings = config("td3", env=EnvConfig("InvertedPendulum-v5", flicker=0.5), seed=3)
    assert train(settings, folder, Console(width=400), stop) == 130
    (printed,) = re.findall(r"to go on:\n  rmc (.*)\n", capsys.readouterr().out)
    raw = json.loads((folder / "config.json").read_bytes())
    assert raw.pop("format") == FORMAT
    del raw["env"]["env_kwargs"], raw["precision"]
    (folder / "config.json").write_text(json.dumps(raw))
    (folder / "history.jsonl").unlink()
    assert rmc([*printed.split(), "--total-steps", "250", "--episodes", "2"]) == 0
    result = RunFolder(folder).result()
    assert (result["env_steps"], result["eval_flicker"]) == (250, 0.5)
    now = dataclasses.replace(settings, total_steps=250, episodes=2, precision="fp32")
    assert read_config(RunFolder(folder)) == now
    (start,) = starts(RunFolder(folder))
    assert (start.env_steps, start.changes) == (1, {"total_steps": [300, 250], "episodes": [5, 2]})
    assert json.loads((folder / "config.json").read_bytes())["format"] == FORMAT


def test_another_agent_is_not_gone_on_with(tmp_path):
    folder = tmp_path / "run"
    stop = StopSignal()
    stop.requested = True
    run(config(), folder, stop)
    with pytest.raises(ConfigError, match="--seed"):
        run(config(seed=1), folder)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").write_text("mine")
    with pytest.raises(ConfigError, match="no baseline's"):
        run(config(), tmp_path / "other")
    with pytest.raises(ConfigError, match="cannot be made"):
        run(config(), Path("/etc/passwd/x"))


def test_one_that_was_killed_has_the_steps_that_it_went_back_to(finished, tmp_path):
    folder = RunFolder(shutil.copytree(finished, tmp_path / "run"))
    (folder.path / "result.json").unlink()
    note_start(folder, {}, LaunchOptions(), None)  # at 200 steps
    with folder.metrics.open("a") as file:  # it came further, unsaved
        file.write(json.dumps({"role": "learner", "time": time.time(), "env_steps": 290, "updates": 3}) + "\n")
    note_start(folder, {}, LaunchOptions(), None)
    assert [start.env_steps for start in starts(folder)] == [0, 200, 200]
    with folder.metrics.open("a") as file:
        file.write(json.dumps({"role": "learner", "time": time.time(), "env_steps": 7, "updates": 3}) + "\n")
    assert recorded_status(folder).env_steps == 7


def test_bursts_of_nothing_are_refused_before_there_is_a_folder(tmp_path):
    with pytest.raises(ConfigError, match=r"--flicker-burst=5.0: nothing is missing"):
        run(config(env=EnvConfig("InvertedPendulum-v5", flicker_burst=5.0)), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_stack_of_frames_belongs_to_the_agent(tmp_path):
    settings = config(env=EnvConfig("InvertedPendulum-v5", flicker=0.5, frame_stack=4), total_steps=100)
    assert run(settings, tmp_path / "run") == 0
    past = of_run(RunFolder(tmp_path / "run"))
    assert past.agent == "SAC 400-300 --frame-stack 4"
    assert past.env == "InvertedPendulum-v5, flicker 0.5"


@pytest.mark.parametrize("body", ["HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Humanoid-v5", "Ant-v5", "mine:Own-v0"])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_zoos_numbers_are_of_the_right_kind(algorithm, body):
    choice = choose(algorithm, "zoo", body)
    assert all(type(choice.arguments[name]) is int for name in ("batch_size", "n_steps") if name in choice.arguments)
    assert choice.normalize == (algorithm in ("ppo", "recurrent-ppo"))


@pytest.mark.parametrize(
    ("algorithm", "env", "gamma"),
    [
        ("sac", "Swimmer-v5", 0.9999), ("crossq", "Swimmer-v5", 0.999), ("ppo", "Swimmer-v5", 0.9999),
        ("td3", "Swimmer-v5", 0.9999), ("ddpg", "Swimmer-v5", 0.9999),
        ("recurrent-ppo", "Reacher-v5", 0.9),
    ],
)  # fmt: skip
def test_the_zoos_discounts(algorithm, env, gamma):
    assert choose(algorithm, "zoo", env).arguments["gamma"] == gamma


def test_the_zoos_ppo_trains_and_keeps_its_scales(zoo, tmp_path):
    """With running statistics of observations, which a run that goes on has again."""
    folder = Path(shutil.copytree(zoo, tmp_path / "run"))
    assert run(dataclasses.replace(ZOO, total_steps=1200), folder) == 0
    for path in (zoo, folder):
        past = of_run(RunFolder(path))
        (scales,) = (path / "checkpoints").glob("*/scales.pkl")
        with scales.open("rb") as file:
            count = pickle.load(file).obs_rms.count
        assert count == pytest.approx(past.env_steps, rel=0.02)
        assert past.updates == 5 * past.env_steps // 32  # gradient steps: 5 epochs, in batches of 32


def test_one_in_use_is_left_as_it_is_and_can_be_stopped(tmp_path, capsys):
    words = ["baseline", "sac", ENV.id, "--total-steps", "1000000", "--checkpoint-steps", "100", "--run-dir"]
    command = [*COMMAND, *words, str(tmp_path / "run")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        while ": return " not in (line := process.stdout.readline()):
            assert line
        before = (tmp_path / "run" / "config.json").read_bytes()
        with pytest.raises(ConfigError, match="stop it first"):
            run(config(total_steps=2_000_000), tmp_path / "run")
        assert (tmp_path / "run" / "config.json").read_bytes() == before
        assert rmc(["stop", str(tmp_path / "run")]) == 0
    assert process.returncode == 130
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == (f"{tmp_path / 'run'} has ended\n", "")


def test_files_that_are_cut_are_named(finished, tmp_path):
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    (state,) = (folder / "checkpoints").iterdir()
    cuts = {folder / "initial.json": "JSON", folder / "config.json": "JSON", state / "progress.json": "JSON"}
    cuts |= dict.fromkeys((state / "replay_buffer.pkl", state / "model.zip"), "cannot be read")
    for path, fault in cuts.items():
        whole = path.read_bytes()
        for cut in (b"", whole[: len(whole) // 2]):
            path.write_bytes(cut)
            if path.name != "progress.json":
                with pytest.raises(ConfigError, match=rf"{folder}.*{fault}"):
                    run(config(total_steps=300), folder)
            if path.name in ("progress.json", "model.zip", "config.json"):
                with pytest.raises(ConfigError, match=rf"{folder}.*{fault}"):
                    evaluate(RunFolder(folder), 1, None, 0.0, lambda _: None)
            assert RunFolder(folder).result() is not None
        path.write_bytes(whole)


def test_what_it_began_with_is_played_again_where_that_was_lost(finished, tmp_path):
    folder = RunFolder(shutil.copytree(finished, tmp_path / "run"))
    kept = json.loads(folder.initial_file.read_bytes())
    folder.initial_file.unlink()
    assert run(config(total_steps=250), folder.path) == 0
    assert json.loads(folder.initial_file.read_bytes()) == kept
    assert folder.result()["initial_return_mean"] == kept["eval_return_mean"]


def test_a_finished_one_is_not_played_again(finished, tmp_path):
    folder = RunFolder(shutil.copytree(finished, tmp_path / "run"))
    before = folder.result_file.read_bytes(), folder.metrics.read_bytes()
    assert run(config(total_steps=200), folder.path) == 0
    assert (folder.result_file.read_bytes(), folder.metrics.read_bytes()) == before


def test_one_without_its_checkpoint_is_refused_or_begins_anew(finished, tmp_path, capsys):
    folder = RunFolder(shutil.copytree(finished, tmp_path / "run"))
    shutil.rmtree(folder.checkpoints)
    with pytest.raises(ConfigError, match="has lost its checkpoint; restore it"):
        run(config(total_steps=250), folder.path)
    assert (folder.lock.ended(), folder.result() is not None) == (0, True)  # as before
    folder.result_file.unlink()  # as one that was killed before its first
    assert train(config(total_steps=250), folder.path, Console(width=400), StopSignal()) == 0
    assert "no checkpoint is there of the 200 steps before; they begin anew" in capsys.readouterr().out
    assert of_run(folder).env_steps == 250


def test_a_start_without_room_takes_no_result_along(finished, tmp_path, monkeypatch):
    folder = RunFolder(shutil.copytree(finished, tmp_path / "run"))
    (folder.checkpoints / "000000000250").mkdir()  # what a save without room has left: it goes first
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(baselines, "note_start", raising(full))
    with pytest.raises(OSError, match="No space left"):
        run(config(total_steps=250), folder.path)
    assert folder.result() is not None
    assert [path.name for path in folder.checkpoints.iterdir()] == ["000000000200"]


def test_a_full_disk_is_waited_out(tmp_path, monkeypatch, capsys):
    folder, write, tries = tmp_path / "run", BaselineModel._write, []

    def full(self, at):
        write(self, at)
        tries.append(at)
        if len(tries) < 4:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(BaselineModel, "_write", full)
    monkeypatch.setattr(baseline_run, "SAVE_SECONDS", 0.0)
    monkeypatch.setattr(baseline_run, "ROOM_SECONDS", 0.0)
    assert train(config(), folder, Console(width=400), StopSignal()) == 0
    assert capsys.readouterr().out.count("finds no room") == 1
    assert [path.name for path in (folder / "checkpoints").iterdir()] == ["000000000300"]
    assert len(tries) > 3


def test_an_evaluation_that_was_stopped_is_made_up(tmp_path, monkeypatch):
    folder, stop = RunFolder(tmp_path / "run"), StopSignal()

    def stopped(*_):
        stop.request()
        raise baseline_run.Stopped

    with monkeypatch.context() as patch:
        patch.setattr(baseline_run.BaselineRun, "_evaluate", stopped)
        assert run(config(), folder.path, stop) == 130
    assert "eval_env_steps" not in folder.metrics.read_text()
    assert run(config(), folder.path) == 0
    assert [one.env_steps for one in of_run(folder).evaluations] == [101, 200, 300]


def test_it_is_played_with_the_time_limit_that_is_given(finished, monkeypatch):
    seconds, made = [], baselines.env_layout
    monkeypatch.setattr(baselines, "env_layout", lambda env: seconds.append(env.env_timeout) or made(env))
    evaluate(RunFolder(finished), 1, env_timeout=7.0)
    assert seconds == [7.0]


def test_the_environments_keywords_and_sizes_are_kept(tmp_path, monkeypatch, capsys):
    env = EnvConfig("tests.habits:Wants-v0", time_limit=20, env_kwargs={"size": 4, "goal": 1.5})
    assert run(config(env=env, total_steps=150), tmp_path / "run") == 0
    assert read_config(RunFolder(tmp_path / "run")).env == env
    assert of_run(RunFolder(tmp_path / "run")).env == "tests.habits:Wants-v0, goal=1.5, size=4, time limit 20"
    grown = Box(-99.0, 99.0, (5,), np.float32)
    monkeypatch.setattr(
        habits.Wants, "__init__", lambda self, **_: vars(self).update(observation_space=grown, goal=1.5)
    )
    says = "the environment now has 5 observations, the run was trained with 4"
    assert rmc(["evaluate", str(tmp_path / "run")]) == 2
    assert says in capsys.readouterr().err
    with pytest.raises(ConfigError, match=says):
        run(config(env=env, total_steps=300), tmp_path / "run")


def test_an_environment_that_raises_is_one_line(tmp_path, capsys, caplog):
    words = ["baseline", "sac", "tests.habits:Stumbles-v0", "--run-dir", str(tmp_path / "run")]
    assert rmc(words) == 1
    assert "the environment's step raises LinAlgError: Singular matrix (habits.py, line " in capsys.readouterr().err
