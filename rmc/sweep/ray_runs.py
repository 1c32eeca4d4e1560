"""Whole runs spread over a Ray cluster, each on the cores of one node; what they leave comes to this machine."""

import os
import time
from contextlib import suppress
from typing import Any

import ray

from rmc.common.errors import ConfigError, last_line
from rmc.common.whole_file import NO_ROOM, write_whole
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.run_lock import ON_RAY, RunLock
from rmc.sweep.job import Job
from rmc.sweep.local_runs import last_log_line
from rmc.sweep.node_run import NodeRun
from rmc.sweep.parcel import Parcel, Stamps, pack, unpack

LOOK_SECONDS = 2.0
BYTES_PER_SECOND = 1e6  # that copies of a run's files take at most, but for the last
LOST = 1


class RayRuns:
    """As many at once as the nodes that are there hold, and at most ``at_once`` where that is above 0."""

    def __init__(self, cores: int, memory: int, gpus: int, at_once: int) -> None:
        """Raises ConfigError where no node can hold a run."""
        self._at_once, self._running = at_once, 0
        self._bundle = {"CPU": cores, "memory": memory} | ({"GPU": gpus} if gpus else {})
        self._needs: dict[str, Any] = {
            "num_cpus": cores,
            "num_gpus": gpus,
            "memory": memory,
            "scheduling_strategy": "SPREAD",
        }
        if not self.capacity():
            resources = f"{cores} CPUs, {memory / 1e9:.2g} GB of memory{f' and {gpus} GPU' if gpus else ''}"
            fix = f"no node of the cluster has {resources}, which a run takes; start one that has"
            raise ConfigError("--launcher", "ray", fix)

    def capacity(self) -> int:
        """How many runs the nodes hold, of those that are there now."""
        nodes = (node["Resources"] for node in ray.nodes() if node["Alive"])
        fit = sum(min(int(has.get(name, 0.0) // amount) for name, amount in self._bundle.items()) for has in nodes)
        return min(fit, self._at_once) if self._at_once else fit

    def has_room(self) -> bool:
        """Whether the nodes hold another one. With no run at all one may wait for a node to come."""
        return self._running == 0 or self._running < self.capacity()

    def start(self, job: Job) -> "RayRun":
        """Ask for a node, and send it what the job's folder has. Raises ConfigError where somebody trains it."""
        lock = RunFolder(job.folder).lock
        job.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        lock.take(elsewhere=ON_RAY)
        self._running += 1
        return RayRun(self, job, self._needs, lock)

    def release(self) -> None:
        """One has ended."""
        self._running -= 1


class RayRun:
    """A run on some node, whose files are copied here again and again; nothing here waits for the node."""

    def __init__(self, runs: RayRuns, job: Job, needs: dict[str, Any], lock: RunLock) -> None:
        self._runs, self._job, self._lost, self._lock = runs, job, "", lock
        self._log = job.log.read_bytes() if job.log.exists() else b""
        brought = pack(job.folder, {})
        self._actor = ray.remote(NodeRun).options(**needs).remote(job.words, job.folder, brought, os.getcwd())
        self._stamps: Stamps = brought.stamps  # of its files, those that are here
        self._pending: Any = self._actor.look.remote(self._stamps, True)
        self._begun, self._killed, self._look_at, self._copy_at = False, False, 0.0, 0.0

    def status(self) -> int | None:
        """Its exit status, once that and all that it left are here."""
        now = time.monotonic()
        if self._pending is None and now >= self._look_at:
            self._pending = self._actor.look.remote(self._stamps, now >= self._copy_at)
        if self._pending is None or not ray.wait([self._pending], timeout=0.0)[0]:
            return None
        try:
            status, parcel, log = ray.get(self._pending)
        except ray.exceptions.RayError as error:
            self._lost = f"its node was lost, or could not start it ({last_line(error)})"
            return self._end(LOST)
        self._begun = True
        if parcel is not None:
            try:
                self._take(parcel, log)
            except OSError as error:
                if error.errno not in NO_ROOM:
                    raise
                if self._killed:
                    self._lost = f"its last files found no room here ({error.strerror})"
                    return self._end(LOST)
                return None  # the next look takes the same answer, once there is room
            self._copy_at = now + parcel.bytes / BYTES_PER_SECOND
        self._pending, self._look_at = None, now + LOOK_SECONDS
        return None if status is None else self._end(status)

    def _take(self, parcel: Parcel, log: bytes) -> None:
        unpack(parcel, self._job.folder, self._stamps)
        self._stamps = parcel.stamps
        self._job.log.parent.mkdir(parents=True, exist_ok=True)
        write_whole(self._job.log, self._log + log)

    def _end(self, status: int) -> int:
        ray.kill(self._actor)
        self._runs.release()
        self._lock.release(None if self._lost else status)
        return status

    def stop(self) -> None:
        """In order, where it has begun; where it waits for a node, it waits no longer."""
        if not self._begun:
            self.kill()
        else:
            self._actor.stop.remote()

    def kill(self) -> None:
        """End it now, with what was copied last."""
        self._killed = True
        with suppress(ray.exceptions.RayError):
            ray.kill(self._actor)

    def last_words(self) -> str:
        return self._lost or last_log_line(self._job.log)
