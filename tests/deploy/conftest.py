"""What tests of processes share."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from rmc.deploy.run.folder import RunFolder
from tests.runs import untrained


@pytest.fixture
def handlers() -> Iterator[None]:
    """Those of this process are back afterwards."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    """A run's that nobody trains."""
    return untrained(tmp_path / "run")
