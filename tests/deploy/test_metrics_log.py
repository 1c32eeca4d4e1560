"""Records are kept whole, on a disk that is full now and then."""

import io
import json
import logging
import os

import pytest
from rich.console import Console

from rmc.deploy.monitor import metrics_log
from rmc.deploy.monitor.metrics_log import MetricsLog
from rmc.deploy.monitor.output import unfailing
from rmc.deploy.monitor.run_status import RunStatus
from rmc.deploy.monitor.view import View
from rmc.deploy.run.folder import RunFolder


def lines(folder: RunFolder) -> list[int]:
    return [json.loads(line)["x"] for line in folder.metrics.read_text().splitlines()]


def test_a_full_disk_is_told_once_and_over_once(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(metrics_log, "RETRY_SECONDS", 0.0)
    kept = MetricsLog(folder, {})
    kept.write({"role": "learner", "x": 1}, 0, {})
    there = kept._lines
    with open("/dev/full", "ab", buffering=0) as full, caplog.at_level(logging.WARNING):
        kept._lines = full.fileno()  # a real ENOSPC
        kept.write({"role": "learner", "x": 2}, 0, {})
        kept.write({"role": "learner", "x": 3}, 0, {})
        kept._lines = there
        kept.write({"role": "learner", "x": 4}, 0, {})
    kept.close()
    assert lines(folder) == [1, 4]
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 2
    assert "is not written" in messages[0]
    assert "is written again" in messages[1]
    assert len(list(folder.path.glob("events.*"))) == 1  # which goes on, too


def test_events_that_find_no_room_leave_no_file(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_log, "RETRY_SECONDS", 0.0)
    kept, write, handles = MetricsLog(folder, {}), metrics_log.os.write, len(os.listdir("/proc/self/fd"))
    room = [False]

    def full(file: int, content: bytes) -> int:
        return write(file, content if content.startswith(b"{") or room[0] else b"")

    monkeypatch.setattr(metrics_log.os, "write", full)
    for number in range(3):
        kept.write({"role": "learner", "x": number}, 0, {})
    assert not list(folder.path.glob("events.*"))
    assert len(os.listdir("/proc/self/fd")) == handles
    room[0] = True
    kept.write({"role": "learner", "x": 3}, 0, {})
    kept.close()
    assert len(list(folder.path.glob("events.*"))) == 1


def test_no_half_of_a_line_is_left(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    kept, write = MetricsLog(folder, {}), metrics_log.os.write
    kept.write({"role": "learner", "x": 1}, 0, {})

    def short(file: int, line: bytes) -> int:
        return write(file, line[:5])

    with monkeypatch.context() as patch:
        patch.setattr(metrics_log.os, "write", short)
        kept.write({"role": "learner", "x": 2}, 0, {})
    assert lines(folder) == [1]
    kept.close()


def test_a_view_that_cannot_be_written_ends_nothing() -> None:
    status = RunStatus("Pendulum-v1", "debug", 0, 100, 4.0)
    with open("/dev/full", "wb", buffering=0) as raw:
        full = io.TextIOWrapper(raw, write_through=True)
        View(status, Console(file=unfailing(full), force_terminal=False)).close()
        with pytest.raises(OSError, match="No space"):
            full.write("x")


@pytest.mark.parametrize("torn", ['{"role": "learner", "x": 1}\n{"role": "lea', '{"role": "lea', "\0\0\0", ""])
def test_a_torn_line_costs_no_record_after_it(folder: RunFolder, torn: str) -> None:
    folder.metrics.write_text(torn)
    kept = MetricsLog(folder, {})
    for x in (2, 3):
        kept.write({"role": "learner", "x": x}, 0, {})
    os.truncate(folder.metrics, folder.metrics.stat().st_size - 5)  # and while the run goes on
    kept.write({"role": "learner", "x": 4}, 0, {})
    kept.close()
    assert [record["x"] for record in folder.records()] == [1, 2, 4][not torn.startswith('{"role": "learner"') :]
    assert b"\n\n" not in folder.metrics.read_bytes()
