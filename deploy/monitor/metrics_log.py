"""A run's records as they are kept: lines of metrics.jsonl and TensorBoard's events. A full disk is waited out.

The events lie in the run's folder itself: TensorBoard calls a run as the folder that they are in.
"""

import errno
import io
import json
import logging
import os
import socket
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.plugins.hparams import summary_v2 as hp
from tensorboard.summary.writer.record_writer import RecordWriter

from rmc.deploy.monitor.main_metrics import MAIN
from rmc.deploy.run.folder import RunFolder

RETRY_SECONDS = 10.0  # until the next try after a write that failed
log = logging.getLogger(__name__)


class MetricsLog:
    """Of one launcher. What is said while nothing can be written is not kept, which the log says once."""

    def __init__(self, folder: RunFolder, options: Mapping[str, Any]) -> None:
        """``options`` are those of the run, by dotted path, for TensorBoard's table of hyperparameters."""
        self._lines = os.open(folder.metrics, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)
        self._folder, self._hparams = folder, _hparams(folder, options)
        self._events: int | None = None
        self._retry_at: float | None = None

    def write(self, record: dict[str, Any], env_steps: int, main: Mapping[str, float]) -> None:
        """A record with its ``role``, at an agent step; ``main`` are more values for TensorBoard, by tag."""
        if self._retry_at is not None and time.monotonic() < self._retry_at:
            return
        try:
            before = b"\n" if _ends_in_a_torn_line(self._lines) else b""
            _append(self._lines, before + json.dumps(record).encode() + b"\n")
            self._add_event(record, env_steps, main)
        except OSError as error:
            if self._retry_at is None:
                log.warning(
                    "%s is not written: %s; it is again once that is over", self._folder.metrics, error.strerror
                )
            self._retry_at = time.monotonic() + RETRY_SECONDS
            return
        if self._retry_at is not None:
            log.warning("%s is written again", self._folder.metrics)
            self._retry_at = None

    def _add_event(self, record: dict[str, Any], env_steps: int, main: Mapping[str, float]) -> None:
        own = {f"{record['role']}/{name}": value for name, value in record.items() if name != "time"}
        values = [
            Summary.Value(tag=tag, simple_value=value)
            for tag, value in (own | dict(main)).items()
            if isinstance(value, int | float)
        ]
        when = record.get("time", time.time())
        if self._events is None:
            self._events = _open_events(self._folder.path, self._hparams)
        _append(self._events, _framed(Event(wall_time=when, step=env_steps, summary=Summary(value=values))))

    def close(self) -> None:
        """All is written by then."""
        for handle in filter(None, (self._lines, self._events)):
            os.close(handle)


def _hparams(folder: RunFolder, options: Mapping[str, Any]) -> list[Summary]:
    """A run's options, and the metric to compare runs by, as TensorBoard's hyperparameters."""
    plain = {
        name: value if isinstance(value, bool | int | float | str) else str(value) for name, value in options.items()
    }
    by = [hp.Metric(f"{MAIN}evaluation_return", display_name="evaluation return")]
    return [hp.hparams_config_pb(list(map(hp.HParam, plain)), by), hp.hparams_pb(plain, folder.path.name)]


def _open_events(folder: Path, hparams: Iterable[Summary]) -> int:
    """A new file of TensorBoard's; its name is one that TensorBoard looks for. Raises OSError."""
    now = time.time()
    for old in (folder / "events").glob("*tfevents*"):  # where earlier versions had them
        old.rename(folder / old.name)
    name = f"events.out.tfevents.{now:010.0f}.{socket.gethostname()}.{os.getpid()}.{time.monotonic_ns()}"
    handle = os.open(folder / name, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        _append(handle, _framed(Event(wall_time=now, file_version="brain.Event:2")))
        for summary in hparams:
            _append(handle, _framed(Event(wall_time=now, summary=summary)))
    except OSError:  # the next try takes another name
        os.close(handle)
        (folder / name).unlink(missing_ok=True)
        raise
    return handle


def _framed(event: Event) -> bytes:
    """An event as it stands in a file, with its length and checksums."""
    frame = io.BytesIO()
    RecordWriter(frame).write(event.SerializeToString())
    return frame.getvalue()


def _append(file: int, content: bytes) -> None:
    """All of it or nothing. Raises OSError."""
    size = os.fstat(file).st_size
    try:
        if os.write(file, content) < len(content):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError:
        with suppress(OSError):
            os.ftruncate(file, size)
        raise


def _ends_in_a_torn_line(file: int) -> bool:
    size = os.fstat(file).st_size
    return size > 0 and os.pread(file, 1, size - 1) != b"\n"
