"""``LearnerActor``: the Ray actor that runs the learner and carries its checkpoints to the head."""

import shutil
import time
from typing import Any

import ray

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import CheckpointError, last_line
from rmc.deploy.local.supervisor import HELD_SECONDS
from rmc.deploy.ray.role_actor import (
    AWAY,
    CLAIM_SECONDS,
    LOOK_SECONDS,
    NAMESPACE,
    SETTLE_SECONDS,
    RoleActor,
    actor_name,
)


class LearnerActor(RoleActor):
    """The learner's: brings the newest checkpoint from the head before, and takes every new one there."""

    def prepare(self) -> None:
        folder = self.scratch / "checkpoints"
        self._folder = CheckpointFolder(folder)
        address = ray.util.get_node_ip_address()  # a node's id is another after each start of Ray
        launcher, (was_here, kept, self._epoch, took) = self._claim(address)
        if not was_here:
            shutil.rmtree(folder, ignore_errors=True)  # of an earlier stay on this node: the run has gone on elsewhere
        local = self._folder.latest()
        newest = ray.get(launcher.newest.remote(local[0] if local is not None else -1))
        if newest is not None:
            self._folder.save(*newest)
            self._folder.note_save(took)
        begins = max((one[0] for one in (local, newest) if one is not None), default=-1)
        self._archived = max((one for one in kept if one <= begins), default=-1)  # above it are damaged ones
        self._folder.note_epoch(max(self._epoch, self._folder.last_epoch()))

    def _claim(self, address: str) -> tuple[Any, tuple[bool, list[int], int, float]]:
        """The launcher, and what it answers."""
        deadline = time.monotonic() + CLAIM_SECONDS
        while True:
            try:
                launcher = self._launcher()
                return launcher, ray.get(launcher.claim.remote(self._incarnation, address))
            except AWAY:
                if time.monotonic() > deadline:
                    raise
                time.sleep(LOOK_SECONDS)

    def _launcher(self) -> Any:
        return ray.get_actor(actor_name(self._task.run, "launcher"), NAMESPACE)

    def tend(self) -> None:
        try:
            self._bring()
            self.trouble = ""
        except AWAY as error:
            self.trouble = f"checkpoints do not reach the head: {last_line(error)}"
            raise

    def _bring(self) -> None:
        numbers, took = self._folder.numbers(), self._folder.last_save()
        for number in numbers:
            if number > self._archived:
                try:
                    files = self._folder.load(number)
                except CheckpointError:  # damaged, or dropped since
                    if number == numbers[-1]:
                        raise
                    continue
                ray.get(self._launcher().archive.remote(self._incarnation, number, files, took))
                self._archived = number
        epoch = self._folder.last_epoch()
        if epoch > self._epoch:
            self._epoch = ray.get(self._launcher().note_epoch.remote(self._incarnation, epoch))

    def patience(self) -> float:
        return self._folder.patience(HELD_SECONDS)

    def flush_artifacts(self) -> None:
        deadline = time.monotonic() + SETTLE_SECONDS
        while time.monotonic() < deadline:
            try:
                self.tend()
                return
            except AWAY as error:
                damaged = isinstance(error, CheckpointError)  # here: the head's own errors are Ray's
                if not (damaged or self._run_ends or self._replaced):  # the head may lack room, or be away
                    deadline = time.monotonic() + SETTLE_SECONDS
                time.sleep(LOOK_SECONDS)
