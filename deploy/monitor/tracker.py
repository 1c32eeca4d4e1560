"""A run's tracker, from the launcher's side: a process of its own that reads ``metrics.jsonl``.

Whatever becomes of it, of its network, its login or its disk, the run goes on as fast as without one.
"""

import json
import logging
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from typing import Any

from rmc.common.errors import ConfigError
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import PATH_VARIABLE
from rmc.deploy.run.tracking import Tracking, kept_tracking

FINISH_SECONDS = 30.0  # for what was logged last to arrive
LOOK_SECONDS = 0.1
log = logging.getLogger(__name__)


def start_tracker(folder: RunFolder) -> "Tracker | None":
    """That of a run, if it has one and it can be started."""
    try:
        tracking = kept_tracking(folder.path)
        return None if tracking is None else Tracker(folder, tracking)
    except (ConfigError, OSError) as error:
        log.warning("the run is not tracked: %s", error)
        return None


class Tracker:
    """Between a launcher's start and its end. What the process has to tell is logged as warnings."""

    def __init__(self, folder: RunFolder, tracking: Tracking) -> None:
        self._name, self._log = tracking.tracker, folder.logs / "tracker.log"
        self._ended = False
        read_from = folder.metrics.stat().st_size if folder.metrics.exists() else 0
        words = [sys.executable, "-P", "-m", "rmc.deploy.monitor.tracker_process", str(folder.path), str(read_from)]
        own = {name for name in os.environ if name.startswith("RMC_") and name != PATH_VARIABLE}
        environment = {name: value for name, value in os.environ.items() if name not in own}
        with self._log.open("ab") as errors:
            self._process = subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, env=environment,
                process_group=0,  # Ctrl-C is the launcher's; in a session of its own, a film's priority would not count
            )  # fmt: skip
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)

    def look(self) -> None:
        """Log what it has told since the last look, and that it has died, if it has."""
        assert self._process.stdout is not None
        for line in (self._process.stdout.read() or b"").decode(errors="replace").splitlines():
            log.warning("%s: %s", self._name, line)
        if not self._ended and self._process.poll() is not None:
            self._ended = True
            log.warning("%s: its process has ended; the run goes on without it, see %s", self._name, self._log)

    def close(self, end: dict[str, Any]) -> None:
        """Tell it how the run has ended, and wait a while until all has arrived; then none of it is left."""
        self.look()
        assert self._process.stdin is not None
        with suppress(OSError):  # it has died
            self._process.stdin.write(json.dumps(end).encode())
            self._process.stdin.close()
        deadline = time.monotonic() + FINISH_SECONDS
        try:
            while self._process.poll() is None and time.monotonic() < deadline:
                time.sleep(LOOK_SECONDS)
        finally:
            late = self._process.poll() is None
            with suppress(ProcessLookupError):  # and what it has started
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        if late:
            log.warning("%s: not all has arrived within %.0f s; see %s", self._name, FINISH_SECONDS, self._log)
        self._ended = True
        self.look()
        assert self._process.stdout is not None
        self._process.stdout.close()
