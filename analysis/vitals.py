"""What a run's records say of its newest stretch of training: means, waits and counters by role.

Kinds are roles without their number: ``actor`` stands for ``actor-0``, ``actor-1`` and so on.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from statistics import mean
from typing import Any, TypeGuard

from rmc.common.bus.metrics_record import is_finite
from rmc.deploy.monitor.run_status import LAUNCHER_SECONDS

SPAN_SECONDS = 600.0  # the newest so much is judged
NEW_START_SECONDS = 60.0  # without a word of anybody: what comes after it is another start of the run
Record = dict[str, Any]


class Vitals:
    """The records of a span. ``None`` stands for what nobody has said."""

    def __init__(self, records: Iterable[Record], span: float = SPAN_SECONDS) -> None:
        """``records`` each with ``role`` and ``time`` (seconds since 1970), in the order in which they came.

        Of the newest start, the newest ``span`` seconds are taken.
        """
        self._roles: dict[str, list[Record]] = defaultdict(list)
        for record in _newest(records, span):
            self._roles[record["role"]].append(record)

    @property
    def roles(self) -> list[str]:
        """Those that have spoken."""
        return sorted(self._roles)

    @property
    def end(self) -> float:
        """Time of the newest record; 0 where there is none."""
        return max((records[-1]["time"] for records in self._roles.values()), default=0.0)

    @property
    def seconds(self) -> float:
        """From the first record to the last."""
        return self.end - min((records[0]["time"] for records in self._roles.values()), default=0.0)

    def of(self, kind: str) -> list[str]:
        """The roles of a kind."""
        return [role for role in self.roles if role.partition("-")[0] == kind]

    def series(self, role: str, name: str) -> list[tuple[float, float]]:
        """(time, value) of a role's metric, where it is a number."""
        records = self._roles.get(role, [])
        return [(record["time"], float(record[name])) for record in records if is_finite(record.get(name))]

    def last(self, role: str, name: str) -> float:
        """A role's newest number; 0 where it has said none."""
        series = self.series(role, name)
        return series[-1][1] if series else 0.0

    def waiting_for(self, role: str) -> str:
        """What a role has waited for last; empty where it did not."""
        reasons = (record["waiting_for"] for record in reversed(self._roles.get(role, [])) if "waiting_for" in record)
        return str(next(reasons, ""))

    def values(self, kind: str, name: str) -> list[float]:
        """All that the roles of a kind have said."""
        return [value for role in self.of(kind) for _, value in self.series(role, name)]

    def mean(self, kind: str, name: str) -> float | None:
        """Over the roles of a kind and the span."""
        values = self.values(kind, name)
        return mean(values) if values else None

    def busy(self, kind: str) -> float | None:
        """Mean share of time spent working, 0 to 1; the last seconds, when actors wait for the end, do not count."""
        shares = [one["busy_share"] for one in self._shared(kind) if one.get("waiting_for") != "the end"]
        return mean(shares) if shares else None

    def waits(self, kind: str) -> dict[str, float]:
        """Mean share of time by what was waited for, the largest first.

        A record names what is waited for as it is made; one that names nothing counts for what its kind waits for most.
        """
        records = [one for one in self._shared(kind) if one.get("waiting_for") != "the end"]
        sums: dict[str, float] = defaultdict(float)
        for one in records:
            sums[str(one.get("waiting_for") or "")] += one["waiting_share"]
        unnamed = sums.pop("", 0.0)
        most = max(sums, key=lambda reason: sums[reason], default="")
        sums[most] += unnamed
        return {reason: sums[reason] / len(records) for reason in sorted(sums, key=lambda one: -sums[one]) if records}

    def _shared(self, kind: str) -> Iterator[Record]:
        """Records that split time; the roles of a lockstep run have one clock for all, in the learner's."""
        for role in self.of(kind):
            for record in self._roles[role]:
                busy, waiting = record.get("busy_share"), record.get("waiting_share")
                if _is_share(busy) and _is_share(waiting) and busy + waiting > 0.0:
                    yield record

    def training(self) -> "Vitals":
        """The same from the learner's first update on."""
        updates = self.series("learner", "updates")
        began = next((time for time, value in updates if value > updates[0][1]), float("inf"))
        records = (one for records in self._roles.values() for one in records if one["time"] > began)
        return Vitals(sorted(records, key=lambda one: float(one["time"])))  # one role may pause while others speak


def _is_share(value: Any) -> TypeGuard[float]:
    return is_finite(value) and 0.0 <= value <= 1.0


def _newest(records: Iterable[Record], span: float) -> list[Record]:
    """Those of the newest span of the newest start."""
    kept: list[Record] = []
    end = 0.0  # a record that could not be sent at once comes later
    trained, began = 0.0, 0.0  # seconds of this start, and when it was
    for record in records:
        if not is_finite(record.get("time")):
            continue
        if record["role"] == "launcher" and is_finite(seconds := record.get("start_s")):
            if seconds < trained:
                kept, end = [], 0.0
            trained, began = seconds, record["time"] - seconds - LAUNCHER_SECONDS
        if kept and abs(record["time"] - end) > NEW_START_SECONDS:  # a pause, or a clock that was set
            kept, end = [], 0.0
        kept.append(record)
        end = max(end, record["time"])
    return [record for record in kept if record["time"] >= max(began, end - span)]
