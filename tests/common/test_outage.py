"""An outage is told when it begins and when it is over."""

import logging

import pytest

from rmc.common.process.outage import OutageLog


def test_once_each(caplog: pytest.LogCaptureFixture) -> None:
    outage = OutageLog("actor-0")
    with caplog.at_level(logging.WARNING):
        outage.end()
        for _ in range(3):
            outage.begin(OSError("no answer"))
        outage.end()
        outage.end()
        outage.begin(OSError("again"))
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 3
    assert messages[0] == "actor-0: waiting for Redis: no answer"
    assert messages[1].startswith("actor-0: Redis is back after ")
    assert messages[2] == "actor-0: waiting for Redis: again"
