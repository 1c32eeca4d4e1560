"""Who trains a run, seen from outside its launcher."""

import io
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rich.console import Console

from rmc.common.errors import ConfigError
from rmc.deploy.monitor import attach, run_status, view
from rmc.deploy.monitor.attach import launcher_pid, stop, watch
from rmc.deploy.monitor.notices import notices
from rmc.deploy.monitor.recorded import empty_status, recorded_status, take_start
from rmc.deploy.run.folder import RESULT, RunFolder
from rmc.deploy.run.launch_options import Launcher, LaunchOptions
from rmc.deploy.run.run_lock import ON_RAY
from rmc.deploy.run.starts import note_start

HOLDER = """
import sys, time
from pathlib import Path
from rmc.deploy.run.folder import RunFolder
folder = RunFolder(Path(sys.argv[1]))
folder.lock.take()
print("locked", flush=True)
sys.stdin.readline()
folder.lock.release(int(sys.argv[2]))
"""


@contextmanager
def holder(folder: RunFolder, status: int) -> Iterator[subprocess.Popen[str]]:
    """A process that has the run's lock, and ends with that status once it is sent a line."""
    words = [sys.executable, "-c", HOLDER, str(folder.path), str(status)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout is not None
        owner.stdout.readline()
        yield owner


def test_a_trainer_is_known_until_it_ends(folder: RunFolder, caplog: pytest.LogCaptureFixture) -> None:
    assert (folder.lock.trainer(), folder.lock.ended()) == (None, None)
    with holder(folder, 130) as owner:
        assert folder.lock.trainer() == owner.pid == launcher_pid(folder)
        with pytest.raises(ConfigError, match="this run is being trained; stop it first"):
            folder.lock.take()
        assert caplog.messages == []  # it is refused at once: nobody waits for the lock
        assert folder.lock.trainer() == owner.pid  # who was refused has changed nothing
        assert folder.lock.ended() is None
        owner.communicate("\n")
    assert (folder.lock.trainer(), folder.lock.ended()) == (None, 130)


def test_a_trainer_that_was_killed_has_not_ended(folder: RunFolder) -> None:
    with holder(folder, 0) as owner:
        owner.kill()
    assert (folder.lock.trainer(), folder.lock.ended()) == (None, None)
    folder.lock.take()
    assert folder.lock.trainer() == os.getpid()
    folder.lock.release()


@pytest.mark.parametrize("number", ["-1", "0", "one", ""])
def test_no_process_but_the_trainer_is_told_to_end(folder: RunFolder, number: str) -> None:
    """In a stranger's folder anything may be written."""
    with holder(folder, 0) as owner, subprocess.Popen(["sleep", "60"]) as other:
        lock, text = folder.path / ".lock", (folder.path / ".lock").read_text()
        lock.write_text(text.replace(str(owner.pid), str(other.pid)))
        with pytest.raises(ConfigError, match=f"its .lock names process {other.pid}, which does not train it"):
            stop(folder)
        lock.write_text(text.replace(str(owner.pid), number))
        assert folder.lock.trainer() is None
        assert other.poll() is None
        other.kill()
        owner.communicate("\n")


def test_a_lock_is_let_go_though_a_forked_process_lives_on(folder: RunFolder) -> None:
    folder.lock.take()
    child = os.fork()
    if child == 0:
        signal.pause()
    folder.lock.release(0)
    try:
        folder.lock.take()
        folder.lock.release()
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def test_a_trainer_on_another_machine_is_not_ours_to_stop(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.lock.take()
    monkeypatch.setattr("socket.gethostname", lambda: "elsewhere")
    assert folder.lock.trained_elsewhere() == ""  # this one, which has another name now
    monkeypatch.setattr("rmc.deploy.run.run_lock.BOOT", folder.path / "config.json")
    with pytest.raises(ConfigError, match=r"is trained on .*; stop it there"):
        stop(folder)
    folder.lock.release()


def test_nor_is_a_sweeps_run_on_ray_whose_roles_are_silent_between_copies(folder: RunFolder) -> None:
    begun(folder, 60.0)
    said = [{"role": role, "time": time.time() - 20.0, "start_s": 40.0} for role in ("launcher", "learner")]
    folder.metrics.write_text("".join(json.dumps(one) + "\n" for one in said))
    folder.lock.take(elsewhere=ON_RAY)
    with pytest.raises(ConfigError, match="is trained on Ray; stop its sweep"):
        stop(folder)
    assert recorded_status(folder).state == "training"
    assert "silent" not in notices(recorded_status(folder))
    folder.lock.release()
    folder.lock.take()
    assert "silent" in notices(recorded_status(folder))
    folder.lock.release()


def test_nor_is_one_in_another_container_of_this_machine(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """There, another process has its number."""
    folder.lock.take()
    assert folder.lock.trained_elsewhere() == ""
    monkeypatch.setattr("os.readlink", lambda path: f"{path} of another")
    with pytest.raises(ConfigError, match=rf"another machine or container called {socket.gethostname()}; stop it"):
        stop(folder)
    folder.lock.release()


def test_nor_is_one_on_another_machine_of_the_same_name(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:  # where a sandbox hides it, the container is known all the same
        patch.setattr("rmc.deploy.run.run_lock.BOOT", folder.path / "none")
        folder.lock.take()
        assert len((folder.path / ".lock").read_text().split()) == 4
        folder.lock.release()
    folder.lock.take()
    monkeypatch.setattr("rmc.deploy.run.run_lock.BOOT", folder.path / "config.json")
    with pytest.raises(ConfigError, match=rf"another machine or container called {socket.gethostname()}; stop it"):
        stop(folder)
    folder.lock.release()


def test_of_several_replay_servers_none_takes_the_steps_back(folder: RunFolder) -> None:
    status = empty_status(folder)
    status.steps_before = 800
    for role, steps in (("replay-0", 400), ("replay-1", 500)):
        status.take({"role": role, "time": time.time(), "env_steps": steps})
        assert status.env_steps == max(800, 900 * (role == "replay-1"))


def test_the_launcher_of_a_thousand_roles_is_heard(folder: RunFolder) -> None:
    status = empty_status(folder)
    restarts = {f"restarts_actor-{number}": 0 for number in range(run_status.MOST_NAMES)}
    status.take({"role": "launcher", "time": time.time(), "redis_away_s": 40.0, **restarts})
    assert list(status.silent()) == ["Redis"]


def test_after_the_clock_was_set_back_silence_is_shown(folder: RunFolder) -> None:
    status = empty_status(folder)
    status.began = time.time() + 3600.0
    for role in ("launcher", "learner"):
        status.take({"role": role, "time": time.time() - 100.0, "start_s": 50.0})
    assert set(status.silent()) == {"launcher", "learner"}


def test_nobody_to_stop_is_said(folder: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nobody trains it now"):
        stop(folder)
    with pytest.raises(ConfigError, match="holds runs; give one of them"):
        stop(RunFolder(tmp_path))


@pytest.mark.parametrize("launcher", ["local", "ray"])
def test_a_launcher_on_ray_is_waited_for_where_it_begins(
    launcher: Launcher, folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It locks the folder once all is imported on the head."""
    monkeypatch.setattr(attach, "AWAY_SECONDS", 0.5)
    note_start(folder, {}, LaunchOptions(folder.path, launcher=launcher), None)
    began = time.monotonic()
    with pytest.raises(ConfigError, match="nobody trains it now"):
        launcher_pid(folder)
    assert (time.monotonic() - began >= 0.5) == (launcher == "ray")


def test_a_finished_run_is_said_to_be(folder: RunFolder) -> None:
    folder.result_file.write_text(json.dumps(dict.fromkeys(RESULT, 1)))
    with pytest.raises(ConfigError, match=r"it is finished; rmc resume \S+ --total-steps N continues it"):
        stop(folder)


def begun(folder: RunFolder, ago: float) -> None:
    """Make its newest start one of so many seconds ago."""
    start = json.loads(folder.history_file.read_bytes())
    folder.history_file.write_text(json.dumps(start | {"time": time.time() - ago}) + "\n")


def test_who_attaches_hears_who_is_silent(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """By what the launcher has written, and if that is nothing, that it is the launcher."""
    monkeypatch.setattr(view, "LINE_SECONDS", 0.1)
    monkeypatch.setattr(view, "REFRESH_SECONDS", 0.05)
    printed, looks, now = io.StringIO(), itertools.count(), time.time()
    monkeypatch.setattr(time, "time", lambda: now)
    begun(folder, 60.0)
    spoke = {"learner": 9.0, "launcher": 40.0}
    folder.metrics.write_text(
        "".join(json.dumps({"role": role, "time": time.time() - ago}) + "\n" for role, ago in spoke.items())
    )
    watch(folder, Console(file=printed, width=500), lambda: next(looks) > 2)
    assert "silent: launcher for 40 s, learner for 9 s" in printed.getvalue()


def test_a_callback_hears_what_is_said_from_now_on(folder: RunFolder) -> None:
    folder.metrics.write_text('{"role": "learner", "time": 1.0, "updates": 1}\n')
    heard: list[object] = []

    def gone() -> bool:
        with folder.metrics.open("a") as lines:
            lines.write('{"role": "learner", "time": 2.0, "updates": 2}\n')
        return True

    watch(folder, Console(quiet=True), gone, heard.append)
    assert heard == [{"role": "learner", "time": 2.0, "updates": 2}]


@pytest.mark.parametrize("words", [{}, {"learner": 900.0, "launcher": 901.0}, {"launcher": 40.0, "learner": 31.0}])
def test_before_the_roles_and_after_them_nobody_is_silent(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, words: dict[str, float]
) -> None:
    """Amid the first evaluation; at a resume, where others spoke before; and amid the last one."""
    monkeypatch.setattr(view, "LINE_SECONDS", 0.1)
    monkeypatch.setattr(view, "REFRESH_SECONDS", 0.05)
    monkeypatch.setattr(run_status, "UNHEARD_SECONDS", 0.2)
    printed, looks = io.StringIO(), itertools.count()
    begun(folder, 60.0)
    said = [{"role": role, "time": time.time() - ago} for role, ago in words.items()]
    ended = [{**said[-1], "finished": 1}] if words.get("launcher") == 40.0 else []
    folder.metrics.write_text("".join(json.dumps(one) + "\n" for one in [*said, *ended]))
    folder.lock.take()
    watch(folder, Console(file=printed, width=500), lambda: next(looks) > 2)
    assert "0 of" in printed.getvalue()
    assert "silent" not in printed.getvalue()
    assert recorded_status(folder).state == "training"
    assert "silent" not in notices(recorded_status(folder))
    folder.lock.release()


def test_who_speaks_and_then_falls_silent_in_a_start_that_goes_on(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though an earlier start has come to its end; roles are given their time from this start's first word on."""
    status, now = empty_status(folder, ("learner", "actor-0")), time.time()
    status.take({"role": "launcher", "time": now - 80.0, "start_s": 5.0})
    status.take({"role": "learner", "time": now - 79.0, "finished": 1})
    begun(folder, 60.0)
    take_start(status, folder)
    assert (status.silent(), status.speaking()) == ({}, set())
    status.take({"role": "launcher", "time": now, "start_s": 0.1})
    assert (status.silent(), status.speaking()) == ({}, {"launcher"})
    monkeypatch.setattr(time, "time", lambda: now + 40.0)
    assert set(status.silent()) == {"launcher", "learner", "actor-0"}
