"""A run's folder: config, secret, metrics, checkpoints, ring, logs, result. The same folder resumes.

``runs/<env>__<preset>__<seed>__<time>/``
"""

import hashlib
import json
import logging
import os
import re
import secrets
import time
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

from rmc.common.bus.metrics_record import is_finite, is_metric, is_plain
from rmc.common.errors import ConfigError
from rmc.common.whole_file import NO_ROOM, private_temporary, write_synced, write_whole
from rmc.deploy.run.config import RunConfig, from_dict, to_json
from rmc.deploy.run.env_sizes import check_sizes
from rmc.deploy.run.migrations import migrated
from rmc.deploy.run.option_names import did_you_mean
from rmc.deploy.run.run_lock import RunLock

log = logging.getLogger(__name__)
SECRET_LENGTH = 64  # hexadecimal characters
ROOM_SECONDS = 1.0  # between looks whether a full disk has room
RESULT = (
    "env_steps",
    "updates",
    "wall_s",
    "eval_return_mean",
    "eval_return_std",
    "eval_episodes",
    "initial_return_mean",
)
RING = re.compile(r"replay(-\d+)?")  # a replay server's folder
COUNTERS = "replay-counters"  # what they have counted
INITIAL = ("eval_return_mean", "eval_return_std", "eval_episodes")


class RunFolder:
    """Names and small files of a run's folder."""

    def __init__(self, path: Path) -> None:
        self.path = Path(os.path.realpath(path))  # unlike resolve, it takes a link to itself
        self.checkpoints, self.logs = self.path / "checkpoints", self.path / "logs"
        self.metrics = self.path / "metrics.jsonl"
        self.secret_file, self.result_file = self.path / "secret", self.path / "result.json"
        self.initial_file, self.sizes_file = self.path / "initial.json", self.path / "sizes.json"
        self.history_file = self.path / "history.jsonl"
        self.lock = RunLock(self.path)
        self._identity = ""  # before it is asked for

    @property
    def name(self) -> str:
        """The run's name in Redis: the folder's, and what tells it from others of that name."""
        return f"{self.path.name}-{self.identity()}"

    def identity(self) -> str:
        """Eight letters: the same after a rename, others for a copy. By them nodes know what they keep of the run."""
        if not self._identity:
            self._identity = self._known_identity()
        return self._identity

    def _known_identity(self) -> str:
        """A rename keeps the folder's inode and when its secret last changed, a remount the latter, a copy neither."""
        if not self.secret_file.exists():
            self.secret()
        note = self.path / "scratch"
        own = [str(self.path.stat().st_ino), str(self.secret_file.stat().st_ctime_ns)]
        words: list[str] = []
        with suppress(OSError, ValueError):  # there is none, or it is damaged
            words = note.read_text().split()
        known = set(words[:-1]) & set(own)
        if known:
            name = words[-1]
        else:  # runs of versions without such a note have the second
            name = secrets.token_hex(4) if note.exists() else hashlib.sha256(self.secret()).hexdigest()[:8]
        if words != [*own, name]:
            with suppress(OSError) if known else nullcontext():  # it may be read-only, or the disk full
                write_whole(note, f"{' '.join([*own, name])}\n".encode())
        return name

    def rings(self) -> list[Path]:
        """The folders of its replay servers' rings, as far as they are there."""
        return [path for path in self.path.glob("replay*") if RING.fullmatch(path.name)]

    def settings(self) -> dict[str, Any]:
        """What ``config.json`` says, also that of a baseline or of an older version.

        Raises ConfigError where this is no run's folder, or of a newer version.
        """
        try:
            raw = read_object(self.path / "config.json")
        except (FileNotFoundError, NotADirectoryError):
            raise ConfigError("RUN", str(self.path), self._why_no_run()) from None
        except OSError as error:
            raise ConfigError("RUN", str(self.path), f"config.json cannot be read ({error.strerror})") from None
        try:
            return migrated(raw)
        except ConfigError as error:
            raise ConfigError("RUN", str(self.path), str(error)) from None

    def _why_no_run(self) -> str:
        """What is there in place of a run's folder, and what to give."""
        if not os.path.exists(self.path):
            return f"is not there{near_run(self.path, '; give the folder of a run')}"
        run = self.path.parent.parent
        if self.path.name.isdecimal() and (run / "config.json").exists():
            return f"is a checkpoint; give its run, {run}"
        if next(self.path.glob("*/config.json"), None) is not None:
            return "holds runs; give one of them, as rmc list names them"
        return "no config.json there; give the folder of a run"

    def is_baseline(self) -> bool:
        """Whether ``rmc baseline`` made it. Raises ConfigError where this is no run's folder."""
        return "algorithm" in self.settings()

    def config(self) -> RunConfig:
        """The run's config. Raises ConfigError, which names the folder, where it cannot be read or is a baseline's."""
        settings = self.settings()
        if "algorithm" in settings:
            fix = "is a baseline's run; only rmc evaluate, plot, report, stats, watch, resume and stop take it"
            raise ConfigError("RUN", str(self.path), fix)
        try:
            return from_dict(RunConfig, settings, "config.json ")
        except ConfigError as error:
            raise ConfigError("RUN", str(self.path), str(error)) from None

    def write_config(self, config: Any) -> None:
        write_whole(self.path / "config.json", f"{to_json(config)}\n".encode())

    def result(self) -> dict[str, Any] | None:
        """What ``result.json`` says, once the run has ended. Raises ConfigError where it is not as it was written."""
        try:
            return read_object(self.result_file, *RESULT)
        except FileNotFoundError:
            return None

    def write_result(self, result: dict[str, Any]) -> None:
        """Write ``result.json``, whole or not at all; in a read-only folder or on a full disk, once it can be."""
        said = False
        while not self._wrote(self.result_file, f"{json.dumps(result, indent=2)}\n".encode()):
            if self.writable() and not said:  # that it is not, others say
                log.warning("%s finds no room; waiting until there is some", self.result_file)
                said = True
            self.lock.check_there()
            time.sleep(ROOM_SECONDS)

    def _wrote(self, path: Path, content: bytes) -> bool:
        """Whether there was room, and a folder that can be written."""
        try:
            if self.writable():
                write_whole(path, content)
                return True
        except OSError as error:
            if error.errno not in NO_ROOM:
                raise
        return False

    def initial(self) -> dict[str, Any] | None:
        """How the untrained policy played, if a start before this one has kept it; damaged, it is as none."""
        try:
            return read_object(self.initial_file, *INITIAL)
        except (OSError, ConfigError):
            return None

    def write_initial(self, played: dict[str, Any]) -> None:
        write_whole(self.initial_file, f"{json.dumps(played, indent=2)}\n".encode())

    def check_sizes(self, env_id: str, sizes: dict[str, Any]) -> None:
        """Raises ConfigError where the environment has other ``sizes`` than when the run began."""
        try:
            before = read_object(self.sizes_file)  # of an older version, some are unknown
        except (OSError, ConfigError):  # damaged, it is as none
            return
        check_sizes(env_id, before, sizes)

    def write_sizes(self, sizes: dict[str, Any]) -> None:
        write_whole(self.sizes_file, f"{json.dumps(sizes)}\n".encode())

    def reopen(self, total_steps: int) -> None:
        """Drop the result where steps are missing: what it says is no longer the end. Raises ConfigError."""
        result = self.result()
        if result is not None and result["env_steps"] < total_steps:
            self.result_file.unlink()

    def event_files(self) -> list[Path]:
        """TensorBoard's, one a start."""
        return list(self.path.glob("events.out.tfevents.*"))

    def records(self) -> Iterator[dict[str, Any]]:
        """Those of ``metrics.jsonl`` that are whole, each with its role."""
        with suppress(FileNotFoundError), self.metrics.open("rb") as lines:
            yield from filter(None, map(parse_record, lines))

    def secret(self) -> bytes:
        """The run's secret, made at first use. Only the owner may read it: where others could, they no longer can.

        Raises ConfigError where the file is cut short.
        """
        if not self.secret_file.exists():
            self._make_secret()
        if self.secret_file.stat().st_mode & 0o077:
            with suppress(OSError):  # a disk without modes, or mounted to be read
                self.secret_file.chmod(0o600)
        secret = self.secret_file.read_bytes().strip()
        if len(secret) < SECRET_LENGTH:
            fix = f"it holds {len(secret)} of {SECRET_LENGTH} characters; remove it, and the run gets another"
            raise ConfigError("secret", str(self.secret_file), fix)
        return secret

    def _make_secret(self) -> None:
        """Whole or not at all; of two processes that do so at once, one is first, and both have its secret."""
        with private_temporary(self.secret_file) as temporary:
            write_synced(temporary, f"{secrets.token_hex(SECRET_LENGTH // 2)}\n".encode())
            _link(temporary, self.secret_file)

    def writable(self) -> bool:
        """Whether files can be made in it."""
        return os.access(self.path, os.W_OK, effective_ids=os.access in os.supports_effective_ids)


def near_run(path: Path, otherwise: str) -> str:
    """The end of a message on a path: where nothing is there, the run beside it of the nearest name."""
    beside = [] if os.path.exists(path) else path.parent.glob("*/config.json")
    return did_you_mean(path.name, (file.parent.name for file in beside), otherwise)


def _link(temporary: Path, path: Path) -> None:
    """Give a file its name, if no other has that."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        pass
    except OSError:  # a disk without hard links: who trains has locked the folder, and is the one who makes it
        temporary.rename(path)


def read_object(path: Path, *numbers: str) -> dict[str, Any]:
    """What a small file of JSON says, with these ``numbers``. Raises ConfigError naming it, OSError."""
    try:
        value = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise ConfigError(path.name, str(path), f"not JSON ({error}); restore it, or take another run") from None
    if not isinstance(value, dict) or not all(is_finite(value.get(name)) for name in numbers):
        expected = f"an object with the numbers {', '.join(numbers)}" if numbers else "an object"
        raise ConfigError(path.name, str(path), f"must be {expected}; restore it, or take another run")
    return value


def parse_record(line: bytes) -> dict[str, Any] | None:
    """The metrics in a line of ``metrics.jsonl``; None where it is torn by a crash, or is no role's.

    It may be a stranger's: nothing in it moves a terminal's cursor.
    """
    with suppress(ValueError, RecursionError):
        record = json.loads(line)
        if isinstance(record, dict) and is_plain(record.get("role")):
            return {name: value for name, value in record.items() if name == "role" or is_metric(name, value)}
    return None
