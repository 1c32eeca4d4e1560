"""Ends a process in which an environment's call hangs, and says which one."""

import faulthandler
import logging
import math
import os
import signal
import sys
import threading
import time
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Self

from rmc.common.process import descendants

log = logging.getLogger(__name__)
LOOK_SECONDS = 0.1
END_SECONDS = 10.0  # that the process has to end what its environment has started
SWITCH_SECONDS = 1e-4  # between threads, then
WARNER = "rmc-env-warnings"  # the thread
STDERR = 2  # an environment may have put something else in sys.stderr's place
HUNG_STATUS = 3  # of a process that ended so
HUNG_WORDS = "Timeout ("  # with which faulthandler begins; its status is 1
SLACK = 1.1  # of the time that a call has, until it counts as one that cannot even be told


class EnvCall:
    """``with`` it, a call into an environment that must return within so many seconds; it costs under a microsecond."""

    current: "EnvCall | None" = None  # of this process
    watched = False
    armed = 0.0  # seconds of the call for which faulthandler is set; 0 where it is not

    def __init__(self, env_id: str, name: str, seconds: float) -> None:
        self.env_id, self.name, self.seconds = env_id, name, seconds
        self.thread, self.over = threading.get_ident(), False

    def __enter__(self) -> Self:
        self._outer, EnvCall.current = EnvCall.current, self
        if EnvCall.watched and not EnvCall.armed:  # at once: it may keep Python's lock before anybody looks
            _arm(self.seconds)
        return self

    def __exit__(self, *_: object) -> None:
        self.over = True  # another thread may put it back
        EnvCall.current, self._outer = self._outer, None  # calls of several threads would make a chain without end
        if EnvCall.armed and EnvCall.current is None and self.name == "close":  # a long import may be next
            _disarm()

    def describe(self) -> str:
        """That it hangs, and where, in a line."""
        frame = sys._current_frames().get(self.thread)
        at = traceback.extract_stack(frame)[-1] if frame is not None else None
        place = f" ({Path(at.filename).name}, line {at.lineno})" if at is not None else ""
        fix = "fix it, or raise --env-timeout"
        return f"ENV={self.env_id!r}: {self.name} has not returned for {self.seconds:g} s{place}; {fix}"


def start() -> None:
    """From now on watch this process, which is ours alone: where a call hangs, a line on stderr and the end of it.

    C code that keeps Python's lock for as long gets faulthandler's traceback in place of the line.
    """
    if signal.getsignal(signal.SIGTSTP) == signal.SIG_DFL:
        signal.signal(signal.SIGTSTP, _suspend)
    EnvCall.watched = True
    threading.Thread(target=_watch, daemon=True, name="watchdog").start()


def warn() -> None:
    """From now on, where this process is not ours alone, a call that hangs is a warning, once."""
    if not EnvCall.watched and WARNER not in {thread.name for thread in threading.enumerate()}:
        threading.Thread(target=_warn, daemon=True, name=WARNER).start()


def _warn() -> None:
    watched, looks = EnvCall.current, 0
    while True:
        time.sleep(LOOK_SECONDS)
        call = EnvCall.current
        looks = looks + 1 if call is watched else 0
        watched = call
        if call is not None and not call.over and looks == math.ceil(call.seconds / LOOK_SECONDS):
            log.warning(call.describe())


def _watch() -> None:
    """Counts looks, not seconds: a process that was stopped for a while has not hung."""
    watched, looks, arm_at = EnvCall.current, 0, float("-inf")
    while True:
        time.sleep(LOOK_SECONDS)
        call = EnvCall.current
        looks = looks + 1 if call is watched else 0
        watched, seconds = call, EnvCall.armed if call is None else call.seconds
        over = looks * LOOK_SECONDS >= seconds
        if over and call is not None:
            _end(call)
        if over:  # this process calls none any more
            arm_at = float("-inf")
            _disarm()
        elif time.monotonic() >= arm_at:
            arm_at = time.monotonic() + (SLACK - 1.0) * seconds
            _arm(seconds)


def _arm(seconds: float) -> None:
    EnvCall.armed = seconds
    faulthandler.dump_traceback_later(SLACK * seconds + LOOK_SECONDS, exit=True, file=STDERR)


def _disarm() -> None:
    EnvCall.armed = 0.0
    faulthandler.cancel_dump_traceback_later()


def _end(call: EnvCall) -> None:
    sys.setswitchinterval(SWITCH_SECONDS)  # the call may be a loop in Python, which is to be ended beside it
    _arm(END_SECONDS)  # anew: with many processes on the machine it takes a while to find ours
    with suppress(OSError, ValueError):
        os.write(STDERR, f"rmc: {call.describe()}\n".encode())
        sys.stdout.flush()
    descendants.end_children()  # a simulator that the environment has started
    os._exit(HUNG_STATUS)


def _suspend(*_: object) -> None:
    """Ctrl-Z: the time until the process goes on is nobody's fault."""
    faulthandler.cancel_dump_traceback_later()
    os.kill(os.getpid(), signal.SIGSTOP)
