"""``sweep.jsonl``: what ran in a sweep's folder, a line a run; and the folder's lock."""

import json
import shlex
from pathlib import Path

from rmc.analysis.history import objects, of_run
from rmc.common.bus.metrics_record import is_complete
from rmc.common.errors import ConfigError
from rmc.common.process.file_lock import release_lock, take_lock
from rmc.common.whole_file import write_whole
from rmc.deploy.run.folder import RunFolder
from rmc.sweep.job import Job
from rmc.sweep.pool import Ending, State

NAME = "sweep.jsonl"
COLUMNS = ("run", "state", "words", "seed", "values", "return", "env_steps", "seconds", "reason")
BY_HAND = "fix or remove its line"
CUT = "that is an earlier evaluation, as the last one was cut or broke; a larger --evaluation-seconds plays it again"


class Index:
    """Of one sweep's folder, which this process alone writes to until it is closed."""

    def __init__(self, folder: Path) -> None:
        """Raises ConfigError where another sweep runs in it, or it cannot be made or read."""
        self.folder, self._path = folder, folder / NAME
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = take_lock(folder / ".lock", patience=0.0)
        except OSError as error:
            raise ConfigError("--sweep-dir", str(folder), f"cannot be used ({error.strerror}); give another") from None
        if self._lock is None:
            fix = "another rmc sweep runs in it; wait until it ends, or give another --sweep-dir"
            raise ConfigError("--sweep-dir", str(folder), fix)
        lines = objects(self._path, *COLUMNS) if self._path.exists() else {}
        self.lines = {str(line["run"]): line for line in lines.values()}
        for name, line in self.lines.items():
            if not isinstance(line["values"], dict):
                raise ConfigError(f"{NAME} {name}", line["values"], f"its values must be an object; {BY_HAND}")

    def close(self) -> None:
        """Let another sweep in."""
        if self._lock is not None:
            release_lock(self._lock)

    def state(self, job: Job) -> str:
        """What became of it so far."""
        return str(self.lines.get(job.name, {}).get("state", "waiting"))

    def begin(self, job: Job) -> None:
        self.put(job, "running")
        self.write()

    def end(self, job: Job, ending: Ending) -> None:
        self.put(job, ending.state, ending.seconds, ending.reason)
        self.write()

    def put(self, job: Job, state: State, seconds: float = 0.0, reason: str = "") -> None:
        """Make its line anew. Seconds are added up over its starts; a start that nobody saw the end of has trained."""
        seconds += self.lines.get(job.name, {}).get("seconds", 0.0)
        returned, env_steps, trained_s = newest_return(job)
        words = f"rmc {shlex.join(job.command(job.folder))}"
        seconds = round(max(seconds, trained_s), 1)
        if state == "finished" and not is_complete(RunFolder(job.folder).result() or {}):
            reason = CUT
        cells = (job.name, state, words, job.seed, job.values, returned, env_steps, seconds, reason)
        self.lines[job.name] = dict(zip(COLUMNS, cells, strict=True))

    def write(self) -> None:
        """All lines, whole or not at all."""
        write_whole(self._path, "".join(f"{json.dumps(line)}\n" for line in self.lines.values()).encode())


def newest_return(job: Job) -> tuple[float | None, int, float]:
    """Of its newest evaluation that was not cut, and the agent steps and seconds of training so far."""
    folder = RunFolder(job.folder)
    if not (folder.path / "config.json").exists():
        return None, 0, 0.0
    result = folder.result()
    if result is not None and is_complete(result):  # no need to read the metrics of days
        return result["eval_return_mean"], result["env_steps"], result["wall_s"]
    try:
        past = of_run(folder)
    except ConfigError:  # none yet
        return None, result["env_steps"] if result is not None else 0, 0.0
    return past.evaluations[-1].return_mean, past.env_steps, past.wall_s
