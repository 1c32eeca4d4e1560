"""What everyone looks at: metrics from the bus to metrics.jsonl, TensorBoard, and a live view or plain lines."""

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rich.console import Console

from rmc.common.bus.metrics_record import is_complete, is_finite
from rmc.common.bus.protocol import Bus
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import BusFull, BusUnavailable
from rmc.common.process.outage import OutageLog
from rmc.deploy.monitor.main_metrics import evaluation_metrics, main_metrics
from rmc.deploy.monitor.metrics_log import MetricsLog
from rmc.deploy.monitor.recorded import Callback, empty_status
from rmc.deploy.monitor.tracker import Tracker
from rmc.deploy.monitor.view import View
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.host import HostFigures
from rmc.deploy.run.metrics_tail import MetricsTail, wall_seconds
from rmc.deploy.run.option_names import flat

RECORD_SECONDS = 5.0  # between the launcher's own records, and looks at the run's folder
TOO_LATE = "checkpoint %d was dropped before its evaluation ended; raise --keep-checkpoints, or lower --episodes"
log = logging.getLogger(__name__)


class Monitor:
    """Reads every role's records and shows them. ``watch`` as often as you like; ``close`` at the end."""

    def __init__(
        self,
        folder: RunFolder,
        config: RunConfig,
        console: Console,
        tracker: Tracker | None = None,
        callback: Callback | None = None,
    ) -> None:
        """``callback`` hears each record until ``close``."""
        self.status = empty_status(folder, config.roles())
        for record in MetricsTail(folder.metrics, recent_bytes=0).take():  # evaluations of earlier starts
            self.status.take_evaluation(record)
        self.restarts: Callable[[], dict[str, int]] = dict  # how often each role was started again
        self.unplaced: Callable[[], list[str]] = list  # roles that run nowhere now
        self._checkpoints = CheckpointFolder(folder.checkpoints, config.learner.keep_checkpoints)
        self.roles: Callable[[], tuple[str, ...]] = config.roles  # who may have something to say
        self._cursors: dict[str, str] = {}
        self._refused = 0  # records and values that could not be read
        self._redis_bytes = 0
        self._started, self._wall_before = time.monotonic(), wall_seconds(folder.metrics)
        self._next_record, self._is_away = 0.0, False
        self._metrics_log, self._host = MetricsLog(folder, flat(config)), HostFigures(folder.path)
        self._folder, self._writable, self._tracker, self._callback = folder, True, tracker, callback
        self._unmarked: dict[int, float] = {}  # returns of checkpoints that may be the best
        self.view, self.outage = View(self.status, console), OutageLog("launcher")

    @property
    def wall_seconds(self) -> float:
        """Seconds trained, over all starts of the run."""
        return self._wall_before + time.monotonic() - self._started

    def learner_finished(self) -> bool:
        """Whether the learner said that all steps are in and its last checkpoint is written."""
        return bool(self.status.get("learner", "finished"))

    def skip_old(self, bus: Bus) -> None:
        """Pass over what an earlier start left in a shared Redis."""
        self._cursors = bus.records_end(self.roles())

    def watch(self, bus: Bus) -> None:
        """Take in what is new. A Redis that is away costs nothing but that, and is noted at once.

        Raises ConfigError where the run's folder was deleted or moved.
        """
        was_away, due = self._is_away, time.monotonic() >= self._next_record
        try:
            self._take_in(bus)
            if due:
                self._find_ends(bus)
                self._redis_bytes = bus.memory_bytes()
            self.outage.end()
        except (BusUnavailable, BusFull) as error:
            self.outage.begin(error)
        self._is_away = self.outage.seconds > 0
        if due or self._is_away != was_away:
            self._next_record = time.monotonic() + RECORD_SECONDS
            self._look_at_folder()
            self._record_launcher()
            if self._tracker is not None:
                self._tracker.look()

    def _find_ends(self, bus: Bus) -> None:
        """A Redis that came back from a snapshot, or empty after the clock was set back, has lower ids than were read.

        What is in a snapshot was read before.
        """
        for role, end in bus.records_end(self.roles()).items():
            if _in_order(end) < _in_order(self._cursors.get(role, "0")):
                self._cursors[role] = end

    def _look_at_folder(self) -> None:
        self._folder.lock.check_there()
        if self._folder.writable() != self._writable:
            self._writable = not self._writable
            change = "can be written again" if self._writable else "is read-only: training goes on, its end waits"
            log.warning("%s %s", self._folder.path, change)

    def _take_in(self, bus: Bus) -> None:
        for record in self._read(bus):  # one read: a role that floods its stream must not keep the launcher
            self.take(record | {"time": time.time()})  # by one clock: machines' clocks differ

    def _read(self, bus: Bus) -> list[dict[str, Any]]:
        self._refused = bus.refused.total()
        records, self._cursors = bus.records({role: self._cursors.get(role, "0") for role in self.roles()})
        return records

    def take(self, record: dict[str, Any]) -> None:
        """Write one record (with its ``role``) and take it into the view."""
        at = self.status.checkpoint_steps(record.get("eval_update"))  # an evaluation belongs where its checkpoint was
        if at is not None:
            record = record | {"eval_env_steps": at}
        self.status.take(record)
        main = main_metrics(self.status) if record["role"] == "launcher" else evaluation_metrics(record)
        self._metrics_log.write(record, self.status.env_steps if at is None else at, main)
        self._mark_best(record)
        if self._callback is not None:
            self._callback(record)

    def _mark_best(self, record: dict[str, Any]) -> None:
        update, score = record.get("eval_update"), record.get("eval_return_mean")
        if record["role"] == "evaluator" and is_complete(record) and isinstance(update, int) and is_finite(score):
            self._unmarked[update] = float(score)
        with suppress(OSError):  # no room; the next record tries again
            for update in list(self._unmarked):
                is_there = self._checkpoints.mark_best(update, self._unmarked[update])
                if not is_there and update > max(self._checkpoints.numbers(), default=-1):
                    continue  # it is on its way from the learner's node
                del self._unmarked[update]
                if not is_there:
                    log.warning(TOO_LATE, update)

    def _record_launcher(self) -> None:
        restarts = {f"restarts_{role}": count for role, count in self.restarts().items()}
        total = sum(restarts.values())
        self.take(
            {
                "role": "launcher",
                "time": time.time(),
                "wall_s": self.wall_seconds,
                "start_s": time.monotonic() - self._started,
                "restarts": total,
                **restarts,
                "refused_values": self._refused,
                "redis_away_s": self.outage.seconds,
                "redis_memory_bytes": self._redis_bytes,
                "not_running": " ".join(self.unplaced()),
                **self._host.take(),
            }
        )

    def close(self) -> None:
        """Show the last state and close the files."""
        self._callback = None  # it could end a run that has just ended
        self._record_launcher()
        self.view.close()
        self._metrics_log.close()


def _in_order(entry: str) -> tuple[int, ...]:
    """The id of an entry, milliseconds and a number, as it is sorted."""
    return tuple(map(int, entry.split("-")))
