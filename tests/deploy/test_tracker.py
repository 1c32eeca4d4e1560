"""A run in real trackers: what arrives, that a resume continues it, and that no tracker's trouble is the run's."""

import json
import logging
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from imageio_ffmpeg import write_frames
from mlflow import MlflowClient

from rmc.analysis.evaluation import initial_policy
from rmc.common.checkpoint import CheckpointFolder
from rmc.deploy.monitor import tracker as tracker_module
from rmc.deploy.monitor.films import Film, Films
from rmc.deploy.monitor.tracker import Tracker, start_tracker
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.tracking import Tracking, keep_tracking, kept_tracking
from tests import wandb_file
from tests.deploy.test_config import with_value
from tests.processes import alive
from tests.runs import untrained
from tests.waiting import wait_until

CLOSED = "http://127.0.0.1:9"  # no service of anyone's
RESULT = {"state": "finished", "env_steps": 1500, "eval_return_mean": 11.5, "env": "InvertedPendulum-v5"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_BASE_URL", CLOSED)
    monkeypatch.setenv("HOME", str(tmp_path))  # where a login would be
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    return untrained(tmp_path / "first")


def started(folder: RunFolder, name: Any, video_every: int = 0) -> Tracker:
    keep_tracking(folder, Tracking(name, "my-project", ("a", "b"), "0123abcd", video_every))
    tracker = start_tracker(folder)
    assert tracker is not None
    return tracker


def trained(folder: RunFolder, env_steps: int, score: float, update: int = 3) -> None:
    """What a start of a run says in its metrics."""
    now = time.time()
    evaluation = {"eval_return_mean": score, "eval_update": update, "eval_env_steps": env_steps}
    records = [
        {"role": "learner", "time": now, "q_loss": 0.5, "updates_per_s": 45.0, "waiting_share": 0.1},
        {"role": "actor-0", "time": now, "waiting_share": 0.9, "waiting_for": "credit"},
        {"role": "replay", "time": now, "env_steps": env_steps, "env_steps_per_s": 95.0},
        {"role": "evaluator", "time": now, **evaluation},
    ]
    with folder.metrics.open("a") as file:
        file.writelines(json.dumps(record) + "\n" for record in records)


def saved(folder: RunFolder) -> None:
    """The checkpoint that is evaluated."""
    progress = json.dumps({"updates": 3, "env_steps": 700}).encode()
    policy = initial_policy(folder.config())
    CheckpointFolder(folder.checkpoints).save(3, {"policy.safetensors": policy, "progress.json": progress})


def video(path: Path) -> str:
    writer = write_frames(str(path), (32, 32))
    writer.send(None)
    for _ in range(3):
        writer.send(bytes(32 * 32 * 3))
    writer.close()
    return str(path)


def train_once(folder: RunFolder, name: str, env_steps: int, end: dict[str, Any]) -> None:
    tracker = started(folder, name)
    trained(folder, env_steps, env_steps / 100)
    tracker.close(end)


def train_twice(folder: RunFolder, name: str, gamma: float = 0.99) -> None:
    """A start that is stopped, and one that finishes, with a video and that discount."""
    train_once(folder, name, 700, {"state": "stopped"})
    folder.write_config(with_value(folder.config(), "update.gamma", gamma))
    train_once(folder, name, 1500, {**RESULT, "video": video(folder.path / "video.mp4")})


def test_wandb_has_the_run_over_its_starts(folder: RunFolder, caplog: pytest.LogCaptureFixture) -> None:
    train_twice(folder, "wandb")
    assert not caplog.messages
    starts = wandb_file.records(folder.path)
    assert len(starts) == 2
    for records, env_steps in zip(starts, (700, 1500), strict=True):
        (run,) = (record.run for record in records if record.HasField("run"))
        assert (run.run_id, run.display_name, run.project, list(run.tags)) == (
            "0123abcd",
            "first",
            "my-project",
            ["a", "b"],
        )
        config = wandb_file.items(run.config.update)
        assert config["env"]["id"] == "InvertedPendulum-v5"
        assert config["update"]["gamma"] == folder.config().update.gamma
        rows = wandb_file.rows(records)
        (evaluation,) = (row for row in rows if "Main/evaluation_return" in row)
        assert (evaluation["env_steps"], evaluation["Main/evaluation_return"]) == (env_steps, env_steps / 100)
        (newest,) = (row for row in rows if "Main/q_loss" in row)
        assert newest["Main/waiting_share_actors"] == 0.9
        assert newest["replay/env_steps_per_s"] == 95.0
        assert not any(name.startswith("actor-") for name in newest)
        assert wandb_file.exit_codes(records) == [0]
    summary = wandb_file.summary(starts[1])
    assert (summary["state"], summary["eval_return_mean"]) == ("finished", 11.5)
    (film,) = folder.path.glob("wandb/offline-run-*/files/media/videos/*.mp4")
    assert film.read_bytes() == (folder.path / "video.mp4").read_bytes()


def test_trackio_has_the_run_over_its_starts(
    folder: RunFolder, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    train_twice(folder, "trackio")
    assert not caplog.messages
    with sqlite3.connect(tmp_path / "trackio" / "my-project.db") as store:
        rows = store.execute("select run_name, run_id, step, metrics from metrics order by id").fetchall()
        ((config,),) = store.execute("select config from configs").fetchall()
    store.close()
    assert {row[0] for row in rows} == {"first-0123abcd"}
    assert len({row[1] for row in rows}) == 1
    logged = [(step, json.loads(metrics)) for *_, step, metrics in rows]
    returns = [(step, one["Main/evaluation_return"]) for step, one in logged if "Main/evaluation_return" in one]
    assert returns == [(700, 7.0), (1500, 15.0)]
    assert [one["Main/q_loss"] for _, one in logged if "Main/q_loss" in one] == [0.5, 0.5]
    (step, last), (film_step, film) = logged[-1], logged[-2]
    assert (step, last["result/eval_return_mean"]) == (1500, 11.5)
    assert (film_step, film["video"]["_type"]) == (1500, "trackio.video")
    assert (tmp_path / "trackio" / "media" / film["video"]["file_path"]).stat().st_size > 100
    about = json.loads(config)
    assert (about["env"]["id"], about["tags"]) == ("InvertedPendulum-v5", ["a", "b"])


def test_trackio_knows_a_run_whose_folder_has_another_name(folder: RunFolder, tmp_path: Path) -> None:
    started(folder, "trackio").close({"state": "stopped", "env_steps": 700})
    renamed = RunFolder(folder.path.rename(tmp_path / "second"))
    keep_tracking(renamed, kept_tracking(renamed.path))
    tracker = start_tracker(renamed)
    assert tracker is not None
    tracker.close(RESULT)
    with sqlite3.connect(tmp_path / "trackio" / "my-project.db") as store:
        assert store.execute("select distinct run_name from metrics").fetchall() == [("first-0123abcd",)]
    store.close()


@pytest.mark.filterwarnings("ignore::sqlalchemy.exc.SADeprecationWarning")  # MLflow's own
def test_mlflow_has_the_run_over_its_starts(
    folder: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    store = f"sqlite:///{tmp_path}/mlflow.db"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", store)
    monkeypatch.chdir(tmp_path)  # where videos go
    train_twice(folder, "mlflow", gamma=0.5)
    assert not caplog.messages
    client = MlflowClient(store)
    experiment = client.get_experiment_by_name("my-project")
    assert experiment is not None
    (run,) = client.search_runs([experiment.experiment_id])
    assert (run.info.run_name, run.info.status) == ("first", "FINISHED")
    assert run.data.tags.keys() >= {"a", "b"}
    assert run.data.params["env.id"] == "InvertedPendulum-v5"
    assert (run.data.params["update.gamma"], run.data.tags["resumed.update.gamma"]) == ("0.99", "0.5")
    assert sum(tag.startswith("resumed.") for tag in run.data.tags) == 1
    returns = client.get_metric_history(run.info.run_id, "Main/evaluation_return")
    assert [(one.step, one.value) for one in returns] == [(700, 7.0), (1500, 15.0)]
    assert run.data.metrics["Main/q_loss"] == 0.5
    assert run.data.metrics["result/eval_return_mean"] == 11.5
    film = client.download_artifacts(run.info.run_id, "videos/1500/video.mp4")
    assert Path(film).read_bytes() == (folder.path / "video.mp4").read_bytes()


@pytest.mark.parametrize(
    "name", [*(pytest.param(one, marks=pytest.mark.long) for one in ("wandb", "trackio")), "videos"]
)
def test_every_second_evaluated_checkpoint_is_filmed(
    name: Any, folder: RunFolder, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    saved(folder)
    tracker = started(folder, name, 2)
    for env_steps, update in ((700, 1), (1500, 3)):  # of the first there is no checkpoint
        trained(folder, env_steps, 1.0, update)
    films = {
        "wandb": "wandb/offline-run-*/files/media/videos/*.mp4",
        "trackio": "../trackio/media/**/*.mp4",
        "videos": "videos/0*.mp4",
    }[name]
    wait_until(lambda: list(folder.path.glob(films)), 150.0, (folder.logs / "tracker.log").read_text)
    tracker.close({"state": "stopped"})
    assert [path.name for path in (folder.path / "videos").iterdir()] == ["000000003.mp4"]
    (arrived,) = folder.path.glob(films)
    assert arrived.stat().st_size > 1_000
    assert not caplog.messages


def test_an_environment_that_says_much_holds_up_no_film(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    talks = "import sys; sys.stderr.write(('x' * 99 + chr(10)) * 2_000); sys.exit('the cause')"
    scripts = iter([talks, "import sys; sys.exit(3)"])
    popen = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda _, **how: popen([sys.executable, "-c", next(scripts)], **how))
    films, deadline = Films(folder, 1), time.monotonic() + 60.0
    for update, cause in ((3, "the cause"), (4, "exit status 3")):  # which has said nothing
        films.take({"eval_update": update}, 700)
        while (film := films.finished()) is None:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        assert film == Film(folder.path / "videos" / f"00000000{update}.mp4", 700, cause)
    films.close()


def test_a_checkpoint_that_is_gone_is_one_warning(folder: RunFolder, caplog: pytest.LogCaptureFixture) -> None:
    tracker = started(folder, "videos", 1)
    trained(folder, 700, 1.0)
    wait_until(lambda: tracker.look() or caplog.messages, 60.0)
    tracker.close({"state": "stopped"})
    (message,) = caplog.messages
    assert message.startswith("videos: no 000000003.mp4: ")


def is_film(process: psutil.Process) -> bool:
    """Whether it is rmc evaluate, of the lowest priority, which a film has a moment after its start."""
    try:
        return "evaluate" in process.cmdline() and process.nice() == 19
    except psutil.Error:  # it has just ended
        return False


def test_a_film_that_is_being_made_ends_with_the_tracker(folder: RunFolder) -> None:
    saved(folder)
    tracker, films = started(folder, "videos", 1), set[psutil.Process]()
    trained(folder, 700, 1.0)
    try:
        wait_until(lambda: films.update(filter(is_film, psutil.Process().children(recursive=True))) or films, 60.0)
    finally:
        tracker.close({"state": "stopped"})
    assert not any(one.is_running() for one in films)
    assert not list((folder.path / "videos").iterdir())


@pytest.mark.parametrize("key", [None, "a" * 40])
def test_without_login_or_network_wandb_is_recorded_offline_and_that_is_said_once(
    folder: RunFolder, key: str | None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("WANDB_MODE")
    if key is not None:
        monkeypatch.setenv("WANDB_API_KEY", key)
    tracker = started(folder, "wandb")
    trained(folder, 700, 7.0)
    tracker.close(RESULT)
    (message,) = caplog.messages
    assert message.startswith("wandb: ")
    assert message.endswith(f"; recorded offline, and wandb sync {folder.path}/wandb/offline-run-* sends it")
    (records,) = wandb_file.records(folder.path)
    assert any(row.get("Main/evaluation_return") == 7.0 for row in wandb_file.rows(records))


def test_a_disk_that_takes_nothing_is_said_and_the_run_goes_on(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("TRACKIO_DIR", "/dev/full/trackio")
    tracker = started(folder, "trackio")
    trained(folder, 700, 7.0)
    tracker.close(RESULT)
    assert caplog.messages
    assert all(message.startswith("trackio: ") for message in caplog.messages)
    assert len(caplog.messages) == 1


def test_one_that_dies_is_said_once(folder: RunFolder, caplog: pytest.LogCaptureFixture) -> None:
    tracker = started(folder, "videos")
    tracker._process.kill()
    tracker._process.wait()
    for _ in range(3):
        tracker.look()
    tracker.close(RESULT)
    (message,) = caplog.messages
    assert "its process has ended; the run goes on without it" in message


def test_one_that_hangs_is_not_waited_for(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tracker_module, "FINISH_SECONDS", 0.5)
    tracker = started(folder, "videos")
    tracker._process.send_signal(signal.SIGSTOP)
    began = time.monotonic()
    for _ in range(100):
        tracker.look()
    assert time.monotonic() - began < 5.0
    tracker.close(RESULT)
    assert time.monotonic() - began < 50.0
    assert tracker._process.poll() is not None
    (message,) = caplog.messages
    assert "not all has arrived within" in message


def test_one_whose_launcher_was_killed_ends_by_itself(folder: RunFolder) -> None:
    keep_tracking(folder, Tracking("wandb", "my-project", (), "0123abcd"))
    code = (
        "import os, sys, pathlib\n"
        "from rmc.deploy.monitor.tracker import start_tracker\n"
        "from rmc.deploy.run.folder import RunFolder\n"
        "print(start_tracker(RunFolder(pathlib.Path(sys.argv[1])))._process.pid, flush=True)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(folder.path)], capture_output=True, text=True, timeout=60)
    wait_until(lambda: not alive([one for one in psutil.process_iter() if one.pid == int(done.stdout)]), 60.0)
    (records,) = wandb_file.records(folder.path)
    assert wandb_file.exit_codes(records) == [1]
    assert wandb_file.summary(records)["state"] == "lost"


def test_it_is_told_no_secret_of_the_run(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RMC_SECRET", "hush")
    tracker = started(folder, "videos")
    process = psutil.Process(tracker._process.pid)
    while not (environment := process.environ()):  # the kernel has none to show amid the start of a program
        time.sleep(0.01)
    tracker.close(RESULT)
    assert "hush" not in environment.values()
    assert environment["HOME"] == os.environ["HOME"]


def test_a_run_whose_tracker_cannot_be_started_goes_on(folder: RunFolder, caplog: pytest.LogCaptureFixture) -> None:
    (folder.path / "tracking.json").write_text("{")
    with caplog.at_level(logging.WARNING):
        assert start_tracker(folder) is None
    assert "the run is not tracked: tracking.json=" in caplog.text
