"""``LauncherActor``: the Ray actor that runs a run's launcher on the head."""

import time
from contextlib import suppress
from pathlib import Path

import ray
from ray.util.placement_group import remove_placement_group

from rmc.common.checkpoint import CheckpointFolder
from rmc.deploy.local.supervisor import QUICK_DEATHS, QUICK_SECONDS
from rmc.deploy.ray.role_actor import NAMESPACE, RoleActor, Task, actor_name


class LauncherActor(RoleActor):
    """The launcher's, on the head: keeps the run's checkpoints in its folder, and ends itself with the run."""

    def __init__(self, task: Task, folder: str, keep: int) -> None:
        self._folder = Path(folder)
        self._checkpoints = CheckpointFolder(self._folder / "checkpoints", keep)
        self._claim = self._folder / "learner-at"  # the node and the life of the host that holds the learner
        super().__init__(task)

    def log_folder(self) -> Path:
        return self._folder / "logs"

    def is_final_exit(self, status: int) -> bool:
        """Only a launcher that was killed begins again, and not for ever; any other end is the run's."""
        if status >= 0:
            return True
        deaths = self._folder / "launcher-deaths"
        recent = [float(word) for word in deaths.read_text().split()] if deaths.exists() else []
        recent = [when for when in recent if time.time() - when < QUICK_SECONDS * QUICK_DEATHS]
        deaths.write_text(" ".join(map(str, [*recent, time.time()])))
        return len(recent) + 1 >= QUICK_DEATHS

    def flush_artifacts(self) -> None:
        """End all that the run still has on the cluster, whatever its launcher left, and this host."""
        run = actor_name(self._task.run, "")
        own = ray.get_runtime_context().current_actor
        for actor in ray.util.list_named_actors(all_namespaces=True):
            if (
                actor["namespace"] == NAMESPACE
                and actor["name"].startswith(run)
                and not actor["name"].endswith("launcher")
            ):
                with suppress(ValueError):
                    ray.kill(ray.get_actor(actor["name"], NAMESPACE), no_restart=True)
        for name in (f"{run}learner", f"{run}replay"):
            with suppress(ValueError):
                remove_placement_group(ray.util.get_placement_group(name))
        ray.kill(own, no_restart=True)

    def claim(self, incarnation: str, node: str) -> bool:
        """Be the host of the learner: no other's checkpoints are taken from now on. Whether the last was there, too."""
        before = self._claim.read_text().split() if self._claim.exists() else []
        self._claim.write_text(f"{node} {incarnation}")
        return before[:1] == [node]

    def archive(self, incarnation: str, number: int, files: dict[str, bytes], took: float) -> None:
        """Keep a checkpoint, and how long the learner took to save, if it comes from the learner's present host."""
        if self._holds(incarnation):
            self._checkpoints.save(number, files)
            self._checkpoints.note_save(took)

    def note_epoch(self, incarnation: str, epoch: int) -> int:
        """Keep the learner's epoch, likewise; returns what is kept."""
        if self._holds(incarnation):
            self._checkpoints.note_epoch(epoch)
        return self.last_epoch()

    def last_epoch(self) -> int:
        """Of the learner; 0 where there was none."""
        return self._checkpoints.last_epoch()

    def last_save(self) -> float:
        """How long the learner's took; 0.0 where there was none."""
        return self._checkpoints.last_save()

    def _holds(self, incarnation: str) -> bool:
        return self._claim.read_text().split()[1:] == [incarnation]

    def newest(self, above: int) -> tuple[int, dict[str, bytes]] | None:
        """The newest whole checkpoint, if it is newer than that."""
        checkpoint = self._checkpoints.latest() if max(self.numbers(), default=-1) > above else None
        return checkpoint if checkpoint is not None and checkpoint[0] > above else None

    def numbers(self) -> list[int]:
        """Of the checkpoints that are kept here."""
        return self._checkpoints.numbers()
