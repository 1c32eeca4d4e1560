"""Words that nobody takes: they end nothing, and a run's log has them."""

import io
import os
import pty
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from rich.console import Console

from rmc.deploy.monitor.output import Output
from rmc.deploy.monitor.run_status import RunStatus
from rmc.deploy.monitor.view import View, terminal

RMC = f"{sys.executable} -m rmc.cli.main"


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(Output, "log", tmp_path / "launcher.log")
    return tmp_path / "launcher.log"


def test_a_reader_that_is_gone_ends_nothing(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    with suppress(BrokenPipeError), os.fdopen(writing, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        console = terminal()
        console.print("seen")
        assert os.read(reading, 100) == b"seen\n"
        os.close(reading)
        console.print("kept")
        assert log.read_text() == "kept\n"
        View(RunStatus("Env-v0", "debug", 0, 10, 1.0), console).close()
    assert log.read_text() == "kept\n"


def test_a_live_view_outlives_its_terminal(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = pty.openpty()
    with suppress(OSError), os.fdopen(theirs, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        monkeypatch.setenv("TERM", "xterm")
        console = terminal()
        view = View(RunStatus("Env-v0", "debug", 0, 10, 1.0), console)
        os.close(ours)
        view._show()
        view.close()
        console.print("kept")
    assert log.read_text().endswith("kept\n")
    assert log.read_text().count("env steps") == 1


def test_a_terminal_that_cannot_draw_gets_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "dumb")
    console = Console(file=io.StringIO(), force_terminal=True)
    view = View(RunStatus("Env-v0", "debug", 0, 10, 1.0), console)
    view._show()
    view.close()
    assert console.file.getvalue().startswith("0% | 0 of 10 steps")  # type: ignore[attr-defined]


def test_a_full_disk_is_over_some_day(log: Path) -> None:
    with open("/dev/full", "w") as stream:
        output = Output(stream)
        output.write("kept\n")
        assert (log.read_text(), output.lost, output.failure) == ("kept\n", False, "No space left on device")
        os.dup2(os.open(log.with_name("room"), os.O_WRONLY | os.O_CREAT), stream.fileno())
        output.write("seen\n")
    assert log.with_name("room").read_text().endswith("seen\n")


@pytest.mark.parametrize(
    ("encoding", "seen"), [("ascii", "1 +- 2 - ? ->"), ("latin-1", "1 +- 2 - ? ->"), ("utf-8", "")]
)
def test_what_a_terminal_cannot_show_is_put_in_other_words(encoding: str, seen: str) -> None:
    raw, text = io.BytesIO(), "1 ± 2 · \N{GREEK SMALL LETTER ALPHA} →"
    output = Output(io.TextIOWrapper(raw, encoding))
    output.write(text)
    assert raw.getvalue().decode(encoding) == (seen or text)


def shell(command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["sh", "-c", command], capture_output=True, text=True, env=os.environ | environment)


@pytest.mark.parametrize(
    ("command", "status", "error"),
    [
        (f"{RMC} --version | true; exit 0", 0, ""),
        (f"{RMC} --help | true", 0, ""),
        (f"{RMC} --help > /dev/full", 1, "rmc: standard output: No space left on device\n"),
        (f"{RMC} --help >&-", 1, "rmc: standard output: Bad file descriptor\n"),
        (f"{RMC} stats /nowhere 2>&-", 2, ""),
        (f"{RMC} stats /nowhere <&- >&- 2> /dev/full", 2, ""),
    ],
)
def test_other_commands_say_what_they_could_not_write(command: str, status: int, error: str) -> None:
    done = shell(command)
    assert (done.returncode, done.stderr) == (status, error)


def test_help_is_shown_where_there_is_only_ascii() -> None:
    done = shell(f"{RMC} train --help", PYTHONIOENCODING="ascii", PYTHONUTF8="0")
    assert (done.returncode, done.stderr) == (0, "")
    assert "--total-steps" in done.stdout


@pytest.mark.parametrize(
    ("away", "launcher"),
    [
        ("| head -c 1 >&2", "lockstep"),
        pytest.param("> /dev/full", "lockstep", marks=pytest.mark.long),
        (">&- 2>&-", "local"),  # whose roles inherit files
    ],
)
def test_a_run_whose_output_goes_away_has_its_result(away: str, launcher: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    words = f"{RMC} train InvertedPendulum-v5 --preset debug --total-steps 600 --run-dir {run} --launcher {launcher}"
    done = shell(f"({words}; echo $? > {tmp_path}/status) {away}", PYTHONIOENCODING="ascii")
    assert (tmp_path / "status").read_text() == "0\n", done.stderr
    assert (run / "result.json").exists()
    assert "after training:" in (run / "logs" / "launcher.log").read_text()
