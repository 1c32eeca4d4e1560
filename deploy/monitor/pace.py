"""How fast a run goes now, from which its end is told."""

from collections import deque

PACE_SECONDS = 60.0  # over which the rate is taken
LEAST_SECONDS = 10.0  # without which there is none
APART_SECONDS = 1.0  # between points


class Pace:
    """The rate of agent steps over the last minute."""

    def __init__(self) -> None:
        self._points: deque[tuple[float, int]] = deque()

    def note(self, when: float, steps: int) -> None:
        """So many steps at a time in seconds."""
        if self._points and (when < self._points[-1][0] or steps < self._points[-1][1]):
            self._points.clear()  # a clock that was set, or a run that went back
        if self._points and when - self._points[-1][0] < APART_SECONDS:
            return
        self._points.append((when, steps))
        while when - self._points[0][0] > PACE_SECONDS:
            self._points.popleft()

    def forget(self) -> None:
        """Begin anew."""
        self._points.clear()

    @property
    def steps_per_s(self) -> float | None:
        """None where too little is known, or no steps came."""
        points = self._points.copy()  # of a view in a thread of its own, while the next point is noted
        if not points:
            return None
        (begin, before), (end, after) = points[0], points[-1]
        if end - begin < LEAST_SECONDS or after <= before:
            return None
        return (after - before) / (end - begin)
