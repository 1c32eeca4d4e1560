"""Stop signals, while a run is trained."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rmc.common.process.role import StopSignal


@contextmanager
def signals_interrupt() -> Iterator[None]:
    """SIGTERM and a closed terminal are KeyboardInterrupt, as SIGINT is, for as long as this lasts."""
    before = interrupt()
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def interrupt() -> dict[signal.Signals, Any]:
    """The same from now on; the handlers before."""
    numbers = [signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # nohup ignores it
        numbers.append(signal.SIGHUP)
    return {number: signal.signal(number, signal.default_int_handler) for number in numbers}


@contextmanager
def signals_caught(hangup: bool = True) -> Iterator[StopSignal]:
    """SIGTERM, SIGINT and a closed terminal only set the signal, for as long as this lasts."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
    stop = StopSignal()
    stop.install()
    if hangup and before[signal.SIGHUP] != signal.SIG_IGN:  # nohup ignores it: the terminal may close
        signal.signal(signal.SIGHUP, lambda *_: stop.request())
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
