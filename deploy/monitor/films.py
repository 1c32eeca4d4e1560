"""Films of evaluated checkpoints while a run trains: ``rmc evaluate --video`` in a process of low priority."""

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from rmc.common.bus.metrics_record import is_finite
from rmc.common.whole_file import temporary_path
from rmc.deploy.run.folder import RunFolder

LOWEST = 19  # priority


@dataclass(frozen=True)
class Film:
    """A checkpoint's video, or why there is none."""

    path: Path
    env_steps: int
    fault: str = ""


class Films:
    """Of every ``every``-th evaluation, 0 for none; one is made at a time, and what comes due meanwhile is left out."""

    def __init__(self, folder: RunFolder, every: int) -> None:
        self._folder, self._every, self._count = folder, every, 0
        self._process: subprocess.Popen[bytes] | None = None
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - a pipe that nobody reads would stop it
        self._film = Film(folder.path, 0)

    def take(self, evaluation: dict[str, Any], env_steps: int) -> None:
        """Begin that of an evaluation's checkpoint, if it is due."""
        self._count += 1
        update = evaluation.get("eval_update")
        if not self._every or self._count % self._every or self._process is not None or not is_finite(update):
            return
        videos = self._folder.path / "videos"
        videos.mkdir(exist_ok=True)
        self._film = Film(videos / f"{update:09d}.mp4", env_steps)
        words = [sys.executable, "-P", "-m", "rmc.cli.main", "evaluate", str(self._folder.path)]
        words += ["--checkpoint", str(update), "--episodes", "1", "--video", str(self._film.path)]
        self._errors.truncate(0)
        self._errors.seek(0)
        self._process = subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=self._errors,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )  # fmt: skip
        os.setpriority(os.PRIO_PROCESS, self._process.pid, LOWEST)

    def finished(self) -> Film | None:
        """The one that has come to its end since the last look."""
        if self._process is None or self._process.poll() is None:
            return None
        status, self._process = self._process.returncode, None
        if status == 0:
            return self._film
        self._errors.seek(0)
        errors = self._errors.read().decode(errors="replace").strip()
        fault = (errors.splitlines() or [f"exit status {status}"])[-1]
        return Film(self._film.path, self._film.env_steps, fault)

    def close(self) -> None:
        """The one that is being made is given up."""
        self._errors.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            temporary_path(self._film.path).unlink(missing_ok=True)
