"""Who trains a run, seen from outside its launcher."""

import io
import itertools
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rich.console import Console

from rmc.common.errors import ConfigError
from rmc.deploy.monitor import view
from rmc.deploy.monitor.attach import launcher_pid, stop, watch
from rmc.deploy.run.folder import RunFolder

HOLDER = """
import sys, time
from pathlib import Path
from rmc.deploy.run.folder import RunFolder
folder = RunFolder(Path(sys.argv[1]))
folder.lock()
print("locked", flush=True)
sys.stdin.readline()
folder.unlock(int(sys.argv[2]))
"""


@contextmanager
def holder(folder: RunFolder, status: int) -> Iterator[subprocess.Popen[str]]:
    """A process that has the run's lock, and ends with that status once it is sent a line."""
    words = [sys.executable, "-c", HOLDER, str(folder.path), str(status)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout is not None
        owner.stdout.readline()
        yield owner


def test_a_trainer_is_known_until_it_ends(folder: RunFolder) -> None:
    assert (folder.trainer(), folder.ended()) == (None, None)
    with holder(folder, 130) as owner:
        assert folder.trainer() == owner.pid == launcher_pid(folder)
        with pytest.raises(ConfigError, match="this run is being trained; stop it first"):
            folder.lock()
        assert folder.trainer() == owner.pid  # who was refused has changed nothing
        assert folder.ended() is None
        owner.communicate("\n")
    assert (folder.trainer(), folder.ended()) == (None, 130)


def test_a_trainer_that_was_killed_has_not_ended(folder: RunFolder) -> None:
    with holder(folder, 0) as owner:
        owner.kill()
    assert (folder.trainer(), folder.ended()) == (None, None)
    folder.lock()
    assert folder.trainer() == os.getpid()
    folder.unlock()


def test_a_trainer_on_another_machine_is_not_ours_to_stop(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.lock()
    monkeypatch.setattr("socket.gethostname", lambda: "elsewhere")
    with pytest.raises(ConfigError, match=r"is trained on .*; stop it there"):
        stop(folder)
    folder.unlock()


def test_nobody_to_stop_is_said(folder: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nobody trains it now"):
        stop(folder)
    with pytest.raises(ConfigError, match=r"no config\.json there"):
        stop(RunFolder(tmp_path))


def test_who_attaches_hears_who_is_silent(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """By what the launcher has written, and if that is nothing, that it is the launcher."""
    monkeypatch.setattr(view, "LINE_SECONDS", 0.1)
    monkeypatch.setattr(view, "REFRESH_SECONDS", 0.05)
    printed, looks = io.StringIO(), itertools.count()
    spoke = {"learner": 9.0, "launcher": 40.0}
    folder.metrics.write_text(
        "".join(json.dumps({"role": role, "time": time.time() - ago}) + "\n" for role, ago in spoke.items())
    )
    watch(folder, Console(file=printed, width=500), lambda: next(looks) > 2)
    assert re.search("silent: launcher for 40 s, learner for (9|10) s", printed.getvalue())
