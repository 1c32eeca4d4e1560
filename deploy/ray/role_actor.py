"""Ray actors that hold a role each: its process, its files and its end. Ray starts them again where they die."""

import os
import shutil
import tempfile
import threading
import time
import uuid
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from urllib.parse import quote

import ray

from rmc.common.errors import CONFIG_STATUS, CheckpointError
from rmc.common.process import descendants
from rmc.common.whole_file import NO_ROOM, write_private
from rmc.deploy.local.role_command import RoleCommand
from rmc.deploy.local.role_process import NO_PROCESS, RoleProcess
from rmc.deploy.ray.node import leave_rays_worker, private_folder

NAMESPACE = "rmc"
LAST_WORDS_SECONDS = 1.5  # a host outlives its role so long, for the launcher to hear why it died
LOOK_SECONDS = 0.5  # between looks for new checkpoints
LOG_BYTES = 64 << 10  # of a role's log in one report
ENDED_IN_ORDER = 0
STOP_SECONDS = 5.0
SETTLE_SECONDS = 60.0  # for the last checkpoint to reach the head
CLAIM_SECONDS = 60.0  # for a launcher that is being started again
FOR_NOW = (*map(os.strerror, (*NO_ROOM, *NO_PROCESS)), "can't start new thread")
AWAY = (ray.exceptions.RayError, ValueError, CheckpointError, OSError)  # of who keeps the checkpoints


@dataclass(frozen=True)
class Task:
    """What a host runs. In its texts ``{scratch}`` is its folder on the node, ``{ip}`` the address.

    ``{scratch_url}`` is the folder as it stands in a URL.
    """

    run: str
    """Its end, the run folder's identity, names the scratch folder."""
    command: RoleCommand
    environment: dict[str, str] = field(repr=False)
    secrets: dict[str, bytes] = field(repr=False)
    """Files that only the owner may read, by name, in the scratch folder."""
    working_folder: str
    """Where the launcher was started; roles start there, too, where the node has such a folder."""


@dataclass(frozen=True)
class RoleReport:
    """How a host's role is."""

    incarnation: str
    """Of the host, which Ray may have started again."""
    node: str
    """Its address."""
    pid: int | None
    status: int | None
    """Exit status, once the role has ended and all that it left is put away."""
    last_words: str
    log: bytes
    """What its log holds past where the last report ended."""
    log_end: int
    trouble: str
    """What keeps it from bringing to the head what belongs there; empty where all is there."""


def scratch_folder(run: str) -> Path:
    """Where this node keeps what a run's roles need at hand. Raises RuntimeError where it is somebody else's.

    Short, for the sockets in it; the run's folder itself lies with its launcher, on the head.
    """
    return private_folder(Path(tempfile.gettempdir()) / f"rmc-ray-{os.getuid()}-{run.rpartition('-')[2]}")


def clear_scratch(run: str) -> None:
    """Remove what a run that is over keeps on this node."""
    shutil.rmtree(scratch_folder(run), ignore_errors=True)


def is_for_now(error: str) -> bool:
    """Whether a node has no room on its disk, no process or no memory to give now.

    By an error's text, which is all that Ray brings from another node.
    """
    return any(words in error for words in FOR_NOW)


def actor_name(run: str, role: str) -> str:
    """The Ray actor's name of a role."""
    return f"{run}:{role}"


class RoleActor:
    """Holds a role. Where it dies this actor ends, too, and Ray starts both again, here or on another node."""

    def __init__(self, task: Task) -> None:
        self._task, self._incarnation = task, uuid.uuid4().hex
        descendants.adopt_orphans()  # what an environment starts ends with its role, also where that is killed
        descendants.spare_children()  # Ray's own
        self._replaced = self._run_ends = False
        self.trouble = ""
        self.scratch = scratch_folder(task.run)
        self._write_secrets()
        self._status: int | None = None
        self.prepare()
        logs = self.log_folder()
        logs.mkdir(exist_ok=True)
        command = replace(task.command, words=tuple(map(self._filled, task.command.words)))
        self._role = RoleProcess(command, self._environment(), logs)
        self._start()

    def _write_secrets(self) -> None:
        for name, content in self._task.secrets.items():
            write_private(self.scratch / name, content)

    def _filled(self, text: str) -> str:
        return (
            text.replace("{scratch}", str(self.scratch))
            .replace("{scratch_url}", quote(str(self.scratch)))
            .replace("{ip}", ray.util.get_node_ip_address())
        )

    def _environment(self) -> dict[str, str]:
        """Without what Ray says to its own workers: a role is none, and the launcher begins a job of its own."""
        leave_rays_worker(self._task.working_folder)
        return {name: self._filled(value) for name, value in self._task.environment.items()}

    def _start(self) -> None:
        self._role.start()
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()

    # What a role's host does beyond holding it.

    def prepare(self) -> None:
        """Before the role starts."""

    def flush_artifacts(self) -> None:
        """After it has ended cleanly."""

    def tend(self) -> None:
        """Once in a while meanwhile."""

    def patience(self) -> float:
        """The seconds that it has to end cleanly."""
        return STOP_SECONDS

    def log_folder(self) -> Path:
        """Where the role's log goes."""
        return self.scratch / "logs"

    def is_final_exit(self, status: int) -> bool:
        """Whether such an end is the last one; after any other, all starts again."""
        ended = status == ENDED_IN_ORDER and (self._task.command.ends or self._run_ends)
        return ended or status == CONFIG_STATUS

    def stopping(self, now: bool) -> None:
        """Whether the run is being ended; where it is not after all, a role that has heard so begins again."""
        self._run_ends = now
        if not now and self._status == ENDED_IN_ORDER and not self._task.command.ends:
            os._exit(1)

    def _watch(self) -> None:
        while not self._role.reap(LOOK_SECONDS):
            with suppress(*AWAY):  # the next look tries again
                self.tend()
        descendants.end_children()
        status = self._role.status
        assert status is not None
        if self._replaced:
            return
        if self.is_final_exit(status):
            self.flush_artifacts()
            self._status = status
        else:
            self._status = status or 1  # an end in order that nobody asked for is a death, too
            time.sleep(LAST_WORDS_SECONDS)
            os._exit(1)

    def report(self, incarnation: str, log_start: int) -> RoleReport:
        """How the role is, and its log from there on; of another incarnation's, from this one's start on."""
        start = log_start if incarnation == self._incarnation else self._role.log_start
        log = b""
        with suppress(FileNotFoundError), self._role.log.open("rb") as file:
            file.seek(start)
            log = file.read(LOG_BYTES)
        words = self._role.last_words() if self._status else ""
        return RoleReport(
            self._incarnation, ray.util.get_node_ip_address(), self._role.pid, self._status, words, log,
            start + len(log), self.trouble,
        )  # fmt: skip

    def restart(self) -> None:
        """End the role cleanly and start it again, because the run's config has changed."""
        self._replaced = True
        self._end()
        self._watcher.join()  # it must not take the new process's absence, or its presence, for the old one's end
        self._replaced = False
        try:
            self._write_secrets()  # a cleaner of temporary files may have taken them
            self._start()
        except (OSError, RuntimeError):  # no process or thread to be had now: Ray starts this host again
            os._exit(1)

    def _end(self) -> None:
        self._role.signal(15)
        if not self._role.reap(self.patience()):
            self._role.signal(9)
            self._role.reap(STOP_SECONDS)
        descendants.end_children()

    def close(self) -> None:
        """End the role, whatever it does, and put away what it left; this actor is killed next."""
        if self._status is None:
            self._replaced = True
            self._end()
            self.flush_artifacts()
