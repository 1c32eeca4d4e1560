"""``LauncherActor``: the Ray actor that runs a run's launcher on the head."""

import os
import signal
import socket
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import ray
from ray.util.placement_group import placement_group_table, remove_placement_group

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import RmcError
from rmc.common.whole_file import write_whole
from rmc.deploy.local.role_process import QUICK_DEATHS, QUICK_SECONDS
from rmc.deploy.local.supervisor import HELD_SECONDS
from rmc.deploy.monitor import attach
from rmc.deploy.monitor.recorded import recorded_status
from rmc.deploy.ray.role_actor import NAMESPACE, RoleActor, Task, actor_name
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.metrics_tail import LISTED_BYTES
from rmc.deploy.run.starts import starts


@dataclass(frozen=True)
class ClusterRunSummary:
    """A run that is trained on a cluster, as ``rmc list`` shows it."""

    env: str
    env_steps: int
    total_steps: int
    learner: str | None
    """The address of its node; None where it has none."""
    actors: int
    """That play now."""
    since: float | None
    """When it was started last, in seconds since the epoch."""
    host: str
    """The head's name, where ``folder`` is."""
    folder: str


class LauncherActor(RoleActor):
    """The launcher's, on the head: keeps the run's checkpoints in its folder, and ends itself with the run."""

    def __init__(self, task: Task, folder: str, keep: int) -> None:
        self._folder, self._asked_to_end = Path(folder), False
        self._checkpoints = CheckpointFolder(self._folder / "checkpoints", keep)
        self._claim = self._folder / "learner-at"  # the address and the incarnation of the learner's host
        try:
            super().__init__(task)
        except (OSError, RuntimeError):  # a full disk, or no process to be had now: nobody else places this host again
            if ray.get_runtime_context().was_current_actor_reconstructed:
                os._exit(1)
            raise

    def log_folder(self) -> Path:
        return self._folder / "logs"

    def is_final_exit(self, status: int) -> bool:
        """Only a launcher that was killed begins again, and not for ever; any other end is the run's."""
        if status >= 0 or self._asked_to_end:
            return True
        deaths = self._folder / "launcher-deaths"
        recent: list[float] = []
        with suppress(OSError, ValueError):  # there were none, or that is damaged
            recent = [float(word) for word in deaths.read_text().split()]
        recent = [when for when in recent if time.time() - when < QUICK_SECONDS * QUICK_DEATHS]
        with suppress(OSError):  # the disk is full
            write_whole(deaths, " ".join(map(str, [*recent, time.time()])).encode())
        return len(recent) + 1 >= QUICK_DEATHS

    def flush_artifacts(self) -> None:
        """End all that the run still has on the cluster, whatever its launcher left, and this host."""
        try:
            self._end_left()
        finally:
            ray.kill(ray.get_runtime_context().current_actor, no_restart=True)

    def _end_left(self) -> None:
        """The roles cleanly: what the learner saves comes here."""
        run, hosts = actor_name(self._task.run, ""), []
        for actor in ray.util.list_named_actors(all_namespaces=True):
            name, ours = actor["name"], actor["namespace"] == NAMESPACE
            if ours and name.startswith(run) and not name.endswith("launcher"):
                with suppress(ValueError):
                    hosts.append(ray.get_actor(name, NAMESPACE))
        if closing := [host.close.remote() for host in hosts]:
            ray.wait(closing, num_returns=len(closing), timeout=self._checkpoints.patience(HELD_SECONDS))
        for host in hosts:
            ray.kill(host, no_restart=True)
        groups = [group["name"] for group in placement_group_table().values() if group["state"] != "REMOVED"]
        for name in filter(lambda name: name.startswith(run), groups):
            with suppress(ValueError):
                remove_placement_group(ray.util.get_placement_group(name))

    def summary(self) -> ClusterRunSummary:
        """How the run is. Raises ConfigError where its folder is damaged."""
        folder = RunFolder(self._folder)
        status, past_starts = recorded_status(folder, LISTED_BYTES), starts(folder)
        heard = status.speaking()
        address = self._claim.read_text().split()[0] if "learner" in heard else None
        actors = sum(role.startswith("actor-") for role in heard)
        since = past_starts[-1].time if past_starts else None
        place = socket.gethostname(), str(folder.path)
        return ClusterRunSummary(status.env, status.env_steps, status.total_steps, address, actors, since, *place)

    def end(self) -> float:
        """Ask the run's launcher to end it cleanly; the seconds that this may take. Raises RmcError where that died."""
        if self._status is not None:
            raise RmcError("the launcher has died, and is started again")
        self._asked_to_end = True  # one that still imports dies of the signal
        if self._role.pid is not None:
            with suppress(ProcessLookupError):  # it has just ended
                os.kill(self._role.pid, signal.SIGTERM)
        return attach.STOP_SECONDS + self._checkpoints.patience(0.0)

    def claim(self, incarnation: str, address: str) -> tuple[bool, list[int], int, float]:
        """Be the host of the learner: no other's checkpoints are taken from now on.

        Whether the last was there, too; the checkpoints' numbers; the learner's epoch, and how long it took to save,
        each 0 where there was none.
        """
        before = self._claim.read_text().split() if self._claim.exists() else []
        write_whole(self._claim, f"{address} {incarnation}".encode())
        return before[:1] == [address], self.numbers(), self._checkpoints.last_epoch(), self._checkpoints.last_save()

    def archive(self, incarnation: str, number: int, files: dict[str, bytes], took: float) -> None:
        """Keep a checkpoint, and how long the learner took to save, if it comes from the learner's present host."""
        if self._holds(incarnation):
            self._checkpoints.save(number, files)
            self._checkpoints.note_save(took)

    def note_epoch(self, incarnation: str, epoch: int) -> int:
        """Keep the learner's epoch, likewise; returns what is kept."""
        if self._holds(incarnation):
            self._checkpoints.note_epoch(epoch)
        return self._checkpoints.last_epoch()

    def _holds(self, incarnation: str) -> bool:
        return self._claim.read_text().split()[1:] == [incarnation]

    def newest(self, above: int) -> tuple[int, dict[str, bytes]] | None:
        """The newest whole checkpoint, if it is newer than that."""
        checkpoint = self._checkpoints.latest() if max(self.numbers(), default=-1) > above else None
        return checkpoint if checkpoint is not None and checkpoint[0] > above else None

    def numbers(self) -> list[int]:
        """Of the checkpoints that are kept here."""
        return self._checkpoints.numbers()
