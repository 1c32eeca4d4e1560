"""A run as the page of ``rmc watch`` shows it: looked at again and again, each time what is new.

A look is a message that JSON can hold: what has changed of the state, and of curves the points that are new.
"""

import math
import re
from pathlib import Path
from typing import Any

from rmc.analysis.vitals import Record, Vitals
from rmc.common.bus.metrics_record import is_finite
from rmc.common.errors import ConfigError
from rmc.deploy.monitor.figures import time_and_eta
from rmc.deploy.monitor.main_metrics import MAIN, evaluation_metrics, main_metrics
from rmc.deploy.monitor.recorded import empty_status, status_json, take_state
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.metrics_tail import MetricsTail
from rmc.deploy.run.starts import format_start, starts

LOOK_BYTES = 1 << 20  # of metrics at a look: a long run's past is read in several
POINTS = 512  # most of a curve; even
EVENTS, SAME_SECONDS = 200, 60.0  # most that are kept; within so long the same thing again is one event
READING = "reading"  # the state while newer words are there, and not taken in yet
KINDS = ("actor", "replay", "learner", "evaluator")
DRAWN = re.compile(r"evaluation_return|episode_return|.*_per_s|.*_loss")  # of the main metrics
SHOWN = (
    "env", "preset", "seed", "state", "env_steps", "total_steps", "share_done", "last_evaluation", "best_evaluation",
    "notices", "result",
)  # fmt: skip
COUNTERS = re.compile(
    r"(?:restarts|dead_letters|refused_clients)_.+|refused_(?:values|weights|priorities)|damaged_.+|broken_episodes"
)
Event = dict[str, Any]


class Curve:
    """A metric over agent steps: every point is the mean of as many values, the last of those so far."""

    def __init__(self) -> None:
        self.points: list[tuple[float, float]] = []
        self._each, self._held, self._news = 1, 1, 0  # values in a point, in the last one; first point to be said

    def add(self, steps: float, value: float) -> None:
        """The newest value."""
        if self.points and self._held < self._each:
            self._held += 1
            (x, y), share = self.points.pop(), 1 / self._held
            steps, value = x + (steps - x) * share, y + (value - y) * share
        else:
            if len(self.points) == POINTS:
                pairs = zip(self.points[::2], self.points[1::2], strict=True)
                self.points = [((a + c) / 2, (b + d) / 2) for (a, b), (c, d) in pairs]
                self._each, self._news = self._each * 2, 0
            self._held = 1
        self._news = min(self._news, len(self.points))
        self.points.append((steps, value))

    def since(self, first: int) -> tuple[int, list[tuple[int, float]]]:
        """The points from the ``first`` on, with as many digits as can be seen."""
        return first, [(round(x), float(f"{y:.5g}")) for x, y in self.points[first:]]

    def news(self) -> tuple[int, list[tuple[int, float]]] | None:
        """Which points take the place of all from the first of them on; None where nothing is new."""
        first, self._news = self._news, len(self.points)
        return self.since(first) if first < len(self.points) else None


class LiveRun:
    """One run; its ``name`` is what the page calls it. Raises ConfigError where the folder is no run's."""

    def __init__(self, name: str, path: Path) -> None:
        self.media: dict[str, Path] = {}
        self._name, self._folder = name, RunFolder(path)
        self._begin()

    def _begin(self) -> None:
        """Know nothing of it yet. Raises ConfigError."""
        self._status, self._began = empty_status(self._folder), self._first_start()
        self._status.steps_before = 0  # all its starts are read
        self._tail = MetricsTail(self._folder.metrics, recent_bytes=None)
        self._curves: dict[str, Curve] = {}
        self._events: list[Event] = []
        self._state: dict[str, Any] = {"name": self._name}

    def _first_start(self) -> float:
        """When it began; 0 where that is not known."""
        return next((start.time for start in starts(self._folder)), 0.0)

    def look(self) -> dict[str, Any] | None:
        """What is new since the last look; None where nothing is. ``whole`` where nothing before holds any more."""
        began = self._began
        found = self._look().items()
        changed = {name: value for name, value in found if name not in self._state or self._state[name] != value}
        curves = {name: news for name, curve in self._curves.items() if (news := curve.news()) is not None}
        self._state |= changed
        if began != self._began:
            return {**self.everything(), "whole": True}
        return {**changed, "curves": curves} if changed or curves else None

    def everything(self) -> dict[str, Any]:
        """The same for a page that knows nothing yet."""
        return {**self._state, "curves": {name: curve.since(0) for name, curve in self._curves.items()}}

    def _look(self) -> dict[str, Any]:
        """The state, or why it cannot be read now."""
        self._status.final_steps = None  # what is read now may be of before the end
        try:
            if self._first_start() not in (0.0, self._began):
                self._begin()  # it was made anew in its folder
            for record in self._tail.take(LOOK_BYTES):
                self._take(record)
            self._status.is_past = not self._tail.at_end
            take_state(self._status, self._folder)
            self._status.total_steps = empty_status(self._folder).total_steps  # a resume may change it
            self.media = newest_media(self._folder.path)
            return self._found()
        except (ConfigError, OSError) as error:
            return {"fault": str(error)}

    def _found(self) -> dict[str, Any]:
        """Raises OSError where a file goes meanwhile."""
        status, over = status_json(self._folder, self._status), self._status.is_over
        main = main_metrics(self._status)
        return {
            **{name: status[name] for name in SHOWN},
            **({"state": READING} if self._status.is_past else {}),
            "fault": "",
            "time": time_and_eta(status["elapsed_s"], status["eta_s"], over),
            **{name: main.get(MAIN + name) for name in ("env_steps_per_s", "updates_per_s")},
            "redis_away": bool(self._status.get("launcher", "redis_away_s")) and not over,
            "roles": self._roles(),
            "events": sorted([*self._starts(), *self._events], key=lambda event: event["time"]),
            "media": {kind: round(path.stat().st_mtime * 1000) for kind, path in self.media.items()},
        }

    def _take(self, record: Record) -> None:
        status, before = self._status, self._status.roles.get(record["role"], {})
        status.take(record)
        for name in filter(COUNTERS.fullmatch, record):
            self._count(record, name, before.get(name, 0))
        if record["role"] == "learner":
            self._draw(main_metrics(status), status.env_steps)
        elif metrics := evaluation_metrics(record):
            at = None if status.last is None else status.last.env_steps
            self._draw(metrics, status.env_steps if at is None else at)

    def _draw(self, metrics: dict[str, float], env_steps: int) -> None:
        for name, value in metrics.items():
            if DRAWN.fullmatch(name := name.removeprefix(MAIN)):
                self._curves.setdefault(name, Curve()).add(env_steps, value)

    def _count(self, record: Record, name: str, before: Any) -> None:
        """Note how far a counter has risen; it begins anew with its role."""
        now, when = record[name], record.get("time")
        if not (is_finite(now) and is_finite(before) and is_finite(when)) or now in (0, before):
            return
        _, _, restarted = name.partition("restarts_")
        what = f"{restarted} started again" if restarted else f"{record['role']}: {name.replace('_', ' ')}"
        same = [one for one in self._events if one["what"] == what and when - one["time"] < SAME_SECONDS]
        for one in same:
            self._events.remove(one)
        count = now - before * (now > before) + sum(one["count"] for one in same)
        self._events.append(_event("restart" if restarted else "refusal", when, self._status.env_steps, what, count))
        del self._events[:-EVENTS]

    def _starts(self) -> list[Event]:
        return [
            _event("start", start.time, start.env_steps, f"start {number} {format_start(start)}".rstrip())
            for number, start in enumerate(starts(self._folder), 1)
            if is_finite(start.time) and is_finite(start.env_steps)
        ]

    def _roles(self) -> list[dict[str, Any]]:
        """By kind, how busy they are and what they wait for, by what they said last."""
        present = self._status.of_this_start()
        said = [record for record in present.values() if is_finite(record.get("time"))]
        said.sort(key=lambda record: record["time"])
        vitals, silent = Vitals(said, math.inf), self._status.silent()
        kinds = {kind: [role for role in present if role.partition("-")[0] == kind] for kind in KINDS}
        return [
            {
                "kind": kind,
                "count": len(roles),
                "busy": vitals.busy(kind),
                "waits": vitals.waits(kind),
                "silent": sum(role in silent for role in roles),
            }
            for kind, roles in kinds.items()
        ]


def _event(kind: str, when: float, env_steps: float, what: str, count: float = 1) -> Event:
    return {
        "kind": kind,
        "time": when,
        "env_steps": env_steps,
        "what": what,
        "count": int(count) if is_finite(count) else 0,
    }


def newest_media(run: Path) -> dict[str, Path]:
    """The newest picture and the newest video in a run's folder, as far as there are."""
    newest = {}
    for kind, patterns in {"picture": ["[!.]*.png"], "video": ["[!.]*.mp4", "videos/[!.]*.mp4"]}.items():
        paths = [path for pattern in patterns for path in run.glob(pattern)]
        files = [path for path in paths if path.is_file() and not path.is_symlink()]
        if files:
            newest[kind] = max(files, key=lambda path: path.stat().st_mtime)
    return newest
