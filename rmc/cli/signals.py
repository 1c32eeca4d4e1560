"""Stop signals, while a run is trained."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

from rmc.common.process.role import StopSignal


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
