"""What tests of processes share."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from rmc.common.env.config import EnvConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import open_run
from rmc.deploy.run.presets import debug


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
    run = open_run(debug(EnvConfig("InvertedPendulum-v5")), LaunchOptions(tmp_path / "run", "fail"))
    run.lock.release()
    return run
