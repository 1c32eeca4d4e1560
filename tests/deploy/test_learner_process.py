"""The learner's process, past its last step."""

import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from rmc.common.bus.redis_bus import RedisBus
from rmc.common.env.config import EnvConfig
from rmc.common.process.role import StopSignal
from rmc.deploy.local import learner_process
from rmc.deploy.local.learner_process import run_learner
from rmc.deploy.local.role_context import RunConnection
from rmc.deploy.redis.registration import Registration
from rmc.deploy.redis.server import RedisServer
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.presets import debug


@pytest.fixture
def server(short: Path) -> Iterator[RedisServer]:
    """A Redis of its own."""
    with RedisServer(short) as redis_server:
        yield redis_server


@pytest.fixture
def place(server: RedisServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunConnection:
    """Of a run whose Redis goes away as soon as its learner has finished."""

    def finish(learner: Any, bus: RedisBus, stop: StopSignal, finished: Any) -> None:
        learner.finished = True
        learner.close()
        server.close()

    monkeypatch.setattr(learner_process, "run_role", finish)
    Registration(debug(EnvConfig("Pendulum-v1")), RunFolder(tmp_path), RedisBus(server.url(), "run"))
    return RunConnection("run", server.url(), "of the run")


@pytest.mark.usefixtures("handlers")
def test_that_it_has_finished_is_said_once_redis_is_back(
    place: RunConnection, server: RedisServer, tmp_path: Path
) -> None:
    over = threading.Event()

    def back() -> None:
        while server.process is not None:
            time.sleep(0.05)
        time.sleep(1.0)
        server.start()
        over.wait()  # Redis ends with the thread that started it

    with ThreadPoolExecutor(1) as pool:
        later = pool.submit(back)
        try:
            run_learner(place, tmp_path / "checkpoints", "cpu")
            (record,), _ = RedisBus(server.url(), "run").records({"learner": "0"})
        finally:
            over.set()
        later.result()
    assert (record["role"], record["finished"]) == ("learner", 1)


@pytest.mark.usefixtures("handlers")
def test_where_redis_stays_away_it_ends_when_it_is_told_to(place: RunConnection, tmp_path: Path) -> None:
    began = time.monotonic()
    timer = threading.Timer(2.0, signal.raise_signal, (signal.SIGTERM,))
    timer.start()
    try:
        run_learner(place, tmp_path / "checkpoints", "cpu")
    finally:
        timer.cancel()
    assert time.monotonic() - began > 1.9
