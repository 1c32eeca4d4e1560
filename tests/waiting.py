"""Waiting for what another process or thread is about to do."""

import time
from collections.abc import Callable


def wait_until(
    condition: Callable[[], object], seconds: float = 30.0, said: Callable[[], object] = str, pause: float = 0.02
) -> None:
    """Look again and again until it holds; fails after so many seconds, with what was ``said``."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, said()
        time.sleep(pause)
