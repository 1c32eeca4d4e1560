"""Stop signals, while a run is trained."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from rmc.common.process.role import StopSignal


@contextmanager
def signals_interrupt() -> Iterator[None]:
    """SIGTERM, SIGINT and a closed terminal are KeyboardInterrupt for as long as this lasts."""
    before = interrupt()
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def interrupt() -> dict[signal.Signals, Any]:
    """The same from now on; the handlers before."""
    before = {number: handler for number, handler in handlers().items() if handler != signal.SIG_IGN}  # as nohup does
    for number in before:
        signal.signal(number, Interrupt())  # another run of this process has heard nothing yet
    return before


class Interrupt:
    """A handler that raises KeyboardInterrupt; it was ``heard`` though a library swallows that, amid its import."""

    def __init__(self) -> None:
        self.heard = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.heard = True
        signal.default_int_handler(number, frame)


def handlers() -> dict[signal.Signals, Any]:
    """Of signals that stop a run, but for those that a program around Python has taken for itself."""
    found = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
    return {number: handler for number, handler in found.items() if handler is not None}


@contextmanager
def signals_caught(hangup: bool = True) -> Iterator[StopSignal]:
    """SIGTERM, SIGINT and a closed terminal only set the signal, for as long as this lasts."""
    before = handlers()
    stop = StopSignal()
    stop.install()
    if any(isinstance(handler, Interrupt) and handler.heard for handler in before.values()):
        stop.request()
    ignored = before.get(signal.SIGHUP, signal.SIG_IGN) == signal.SIG_IGN  # nohup does so: the terminal may close
    if hangup and not ignored:
        signal.signal(signal.SIGHUP, lambda *_: stop.request())
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
