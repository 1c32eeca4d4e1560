"""Reads a run's ``metrics.jsonl``, also while it grows, and without parsing all of one that is long."""

import mmap
import os
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from rmc.common.bus.metrics_record import is_finite
from rmc.deploy.run.folder import parse_record

RECENT_BYTES = 16 << 20  # at the end of a file, within which every role has said all of its metrics
LISTED_BYTES = 1 << 18  # the same where many runs are listed: each has said what a list shows
EVALUATION, WALL = b'"eval_return_mean"', b'"wall_s"'


class MetricsTail:
    """The records of a file: first every evaluation and what is recent, then what is new at each look."""

    def __init__(self, path: Path, recent_bytes: int | None = RECENT_BYTES, read_from: int = 0) -> None:
        """``recent_bytes`` at the end are read whole, of None all.

        ``read_from`` is the byte from which on records are wanted; then there are no evaluations before.
        """
        self._path, self._recent_bytes, self._position = path, recent_bytes, read_from
        self.at_end = True  # whether the last look has reached the end

    def take(self, most_bytes: int = -1) -> list[dict[str, Any]]:
        """Those that are new since the last call, or the first ``most_bytes`` of them."""
        with suppress(FileNotFoundError), self._path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            before: list[dict[str, Any]] = []
            if self._recent_bytes is not None and self._position == 0 and size > self._recent_bytes:
                before, self._position = _evaluations(file, size - self._recent_bytes)
            self._position = min(self._position, size)  # it may have been cut
            file.seek(self._position)
            text = file.read(most_bytes)
            self.at_end = self._position + len(text) >= size
            whole = text[: text.rfind(b"\n") + 1]
            if not (whole or self.at_end):  # no record is so long: it is passed over
                whole = text
            self._position += len(whole)
            return [*before, *filter(None, map(parse_record, whole.splitlines()))]
        return []


def _evaluations(file: BinaryIO, size: int) -> tuple[list[dict[str, Any]], int]:
    """The evaluations in the lines that are whole within the first ``size`` bytes, and where those lines end."""
    records = []
    with mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ) as content:
        end = content.rfind(b"\n") + 1
        at = content.find(EVALUATION, 0, end)
        while at >= 0:
            stop = content.find(b"\n", at)
            records.append(parse_record(content[content.rfind(b"\n", 0, at) + 1 : stop]))
            at = content.find(EVALUATION, stop, end)
    return [record for record in records if record is not None], end


def wall_seconds(metrics: Path) -> float:
    """How long a run was trained before, over all its starts: the launcher's last word says it."""
    with (
        suppress(FileNotFoundError, ValueError),  # ValueError: it is empty
        metrics.open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content,
    ):
        end = content.rfind(b"\n") + 1
        while (at := content.rfind(WALL, 0, end)) >= 0:
            stop, end = content.find(b"\n", at), content.rfind(b"\n", 0, at) + 1
            record = parse_record(content[end:stop]) or {}
            if record.get("role") == "launcher" and is_finite(seconds := record.get("wall_s")):
                return float(seconds)
    return 0.0
