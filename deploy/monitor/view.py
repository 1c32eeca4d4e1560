"""A run shown on a console while it goes: a live table on a terminal, else a plain line now and then."""

import sys
import threading

from rich.console import Console, RenderableType
from rich.live import Live

from rmc.deploy.monitor.output import unfailing
from rmc.deploy.monitor.plain_line import line
from rmc.deploy.monitor.run_status import RunStatus
from rmc.deploy.monitor.table import table
from rmc.deploy.run.state import State

REFRESH_SECONDS = 0.5  # of a live view
LINE_SECONDS = 10.0  # between plain lines


def terminal(width: int | None = None) -> Console:
    """What is printed, shown as it is: a name may hold what a console takes for markup."""
    return Console(file=unfailing(sys.stdout), width=width, markup=False, emoji=False, highlight=False)


class View:
    """A run's status shown on a console, live where a terminal can; by a thread, whatever its owner waits for."""

    def __init__(self, status: RunStatus, console: Console) -> None:
        self._status, self._console, self._over = status, console, threading.Event()
        self._live: Live | None = None
        if console.is_terminal and not console.is_dumb_terminal:  # on which nothing can be drawn anew
            self._live = Live(self._table(), console=console, auto_refresh=False)
            self._live.start()
        self._thread = threading.Thread(target=self._draw, name="view", daemon=True)
        self._thread.start()

    def _draw(self) -> None:
        seconds = REFRESH_SECONDS
        while not self._over.wait(seconds):
            self._show()
            seconds = REFRESH_SECONDS if self._live else LINE_SECONDS

    def _show(self) -> None:
        if getattr(self._console.file, "lost", False):  # nobody sees it
            return
        if self._live is not None:
            self._live.update(self._table(), refresh=True)
        else:
            self._console.print(line(self._status), soft_wrap=True)

    def _table(self) -> RenderableType:
        """With a row left for the cursor."""
        return table(self._status, self._console.width, self._console.height - 1)

    def close(self, state: State | None = None) -> None:
        """Show the last state, and leave it there."""
        self._over.set()
        self._thread.join()
        self._status.state = state
        self._show()
        if self._live is not None:
            self._live.stop()
