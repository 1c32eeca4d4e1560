"""Real shells complete commands, options and folders with what ``rmc completion`` prints."""

import os
import pty
import select
import shutil
import sys
import time
from pathlib import Path

import pytest

from rmc.cli import main

BIN = Path(sys.executable).parent
START = {
    "bash": (["bash", "--norc", "-i"], "source rmc.script; rm rmc.script"),
    "fish": (["fish", "--no-config", "-i"], "source rmc.script; rm rmc.script"),
    "zsh": (["zsh", "-f", "-i"], "autoload -U compinit; compinit -u; fpath=($PWD $fpath); compinit -u"),
}


class Shell:
    """An interactive shell on a terminal of its own."""

    def __init__(self, name: str, folder: Path) -> None:
        words, self._begin = START[name]
        self._pid, self._terminal = pty.fork()
        if self._pid == 0:
            os.chdir(folder)
            os.environ.update(TERM="dumb", HOME=str(folder), PATH=f"{BIN}:{os.environ['PATH']}")
            os.execvp(words[0], words)
        self.type(f"{self._begin}; echo rea''dy\r", "ready")

    def type(self, text: str, wanted: str, seconds: float = 20.0) -> str:
        """What it shows after some keys, once ``wanted`` is in there."""
        os.write(self._terminal, text.encode())
        shown, deadline = "", time.monotonic() + seconds
        while wanted not in shown:
            assert time.monotonic() < deadline, shown
            if select.select([self._terminal], [], [], 0.1)[0]:
                shown += os.read(self._terminal, 65536).decode(errors="replace")
        return shown

    def close(self) -> None:
        os.close(self._terminal)
        os.waitpid(self._pid, 0)


@pytest.mark.parametrize("name", ["bash", "fish", "zsh"])
def test_a_shell_completes(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if shutil.which(name) is None:
        pytest.skip(f"no {name} here")
    assert main.run(["completion", name]) == 0
    (tmp_path / ("_rmc" if name == "zsh" else "rmc.script")).write_text(capsys.readouterr().out)
    (tmp_path / "runs" / "first").mkdir(parents=True)
    shell = Shell(name, tmp_path)
    try:
        for typed, completed in [
            ("rmc tr\t", "train "),
            ("rmc train X --total-st\t", "--total-steps "),
            ("rmc train X --preset de\t", "--preset debug"),
            ("rmc train X --run-dir runs/f\t", "runs/first"),
            ("rmc evaluate runs/f\t", "runs/first"),
            ("rmc evaluate \t", "runs/"),
            ("rmc role act\t", "role actor"),
        ]:
            shell.type(typed, completed)
            shell.type("\x15", "")  # clears the line
    finally:
        shell.close()
