"""The replay server as a process's role: both its ends at once, and one end while the other is away."""

import os
import signal
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from rmc.common.bus.redis_bus import RedisBus
from rmc.common.bus.redis_connection import TIMEOUT_SECONDS
from rmc.common.errors import BusUnavailable, FencedError
from rmc.common.process.role import StopSignal, run_role
from rmc.common.replay import SampleStatus
from rmc.deploy.redis.server import RedisServer
from rmc.learner.replay.client import ReplayClient
from rmc.replay_server import process
from rmc.replay_server.config import ReplayConfig
from rmc.replay_server.process import ReplayProcess
from rmc.replay_server.server import ReplayServer
from rmc.replay_server.socket_server import SocketServer
from tests.replay_server.support import SPEC, Sender
from tests.waiting import wait_until

SECRET = b"the run's secret"


class Running:
    """A replay process's loop in a thread, as ``run_role`` runs it."""

    def __init__(self, folder: Path, bus: RedisBus) -> None:
        config = ReplayConfig(capacity=1000, replay_ratio=1e6, warmup_steps=0)
        self.server = ReplayServer(SPEC, config, folder / "replay", 1, 10**9, 1, 1000, bus)
        sockets = SocketServer(self.server, f"unix:{folder}/r.sock", SECRET, 64)
        self.process, self.stop = ReplayProcess(self.server, sockets), StopSignal()
        self.thread = threading.Thread(target=partial(run_role, self.process, bus, self.stop, idle_seconds=0.0))
        self.thread.start()

    def end(self) -> None:
        self.stop.request()
        self.thread.join()


def client_of(bus: RedisBus, epoch: int = 0) -> ReplayClient:
    client = ReplayClient(lambda: bus.replay_address("replay"), SECRET, SPEC, 16)
    client.register_learner(epoch)
    return client


def test_windows_in_batches_out_and_metrics(redis_url: str, run_name: str, tmp_path: Path) -> None:
    bus = RedisBus(redis_url, run_name)
    running = Running(tmp_path, RedisBus(redis_url, run_name))
    try:
        wait_until(lambda: bus.replay_address("replay") is not None)
        sender, client = Sender(bus), client_of(bus)
        assert client.sample(16).status is SampleStatus.WAIT
        for _ in range(10):
            sender.send(5)
        wait_until(lambda: running.server.stats()["windows"] == 50)
        wait_until(lambda: client.sample(16).status is SampleStatus.BATCH)
        sample = client.sample(16)
        assert sample.rows is not None
        assert (sample.rows["reward"][:, 0] == sample.rows["serial"]).all()
        client.update_priorities(sample.rows["serial"].copy(), np.full(16, 5.0, np.float32))
        client.statistics()  # sends what is enqueued
        wait_until(lambda: running.server.stats()["max_priority"] == 5.0)
        wait_until(
            lambda: bus.records({"replay": "0"})[0][-1:] and bus.records({"replay": "0"})[0][-1]["windows"] == 50
        )
        record = bus.records({"replay": "0"})[0][-1]
        assert record["env_steps"] == 200
        assert record["waiting_for"] == "draws"  # of which it would allow more
        assert 0.0 <= record["busy_share"] <= 1.0
        client.close()
    finally:
        running.end()
    assert not (tmp_path / "r.sock").exists()


def test_a_replaced_learner_that_comes_first_is_not_served(
    redis_url: str, run_name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "ANNOUNCE_PERIOD", 0.05)
    bus = RedisBus(redis_url, run_name)
    stale, epoch = bus.take_epoch("learner"), bus.take_epoch("learner")
    running = Running(tmp_path, RedisBus(redis_url, run_name))
    try:
        wait_until(lambda: bus.replay_address("replay") is not None)
        with pytest.raises(FencedError, match=f"the learner of epoch {stale} was replaced by {epoch}"):
            client_of(bus, stale).sample(16)
        metrics = running.process.metrics()
        assert (metrics["refused_clients"], metrics["refused_clients_fenced"]) == (1, 1)
        client = client_of(bus, epoch)
        assert client.sample(16).status is SampleStatus.WAIT
        bus.take_epoch("learner")  # by a third, which has not come yet
        with pytest.raises(FencedError):
            wait_until(lambda: client.sample(16).status is SampleStatus.BATCH)
        client.close()
    finally:
        running.end()


def test_where_its_sockets_file_is_removed_it_is_made_again(
    redis_url: str, run_name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cleaner of temporary files takes what nobody has opened for days. Who is connected stays so."""
    monkeypatch.setattr(process, "ANNOUNCE_PERIOD", 0.05)
    bus = RedisBus(redis_url, run_name)
    running = Running(tmp_path, RedisBus(redis_url, run_name))
    try:
        wait_until(lambda: bus.replay_address("replay") is not None)
        first = client_of(bus)
        assert first.sample(16).status is SampleStatus.WAIT
        (tmp_path / "r.sock").unlink()
        wait_until((tmp_path / "r.sock").exists)
        second = client_of(bus)
        assert [client.sample(16).status for client in (first, second)] == [SampleStatus.WAIT] * 2
        first.close()
        second.close()
    finally:
        running.end()
    assert not (tmp_path / "r.sock").exists()


@pytest.mark.timeout(90)
def test_the_learner_is_served_while_redis_is_away_and_intake_goes_on_after(tmp_path: Path) -> None:
    folder = tmp_path / "redis"
    folder.mkdir(mode=0o700)
    redis_server = RedisServer(folder)
    redis_server.start()
    bus = RedisBus(redis_server.url(), "run")
    running = Running(tmp_path, RedisBus(redis_server.url(), "run"))
    try:
        wait_until(lambda: bus.replay_address("replay") is not None)
        sender, client = Sender(bus), client_of(bus)
        sender.send(40)
        wait_until(lambda: client.sample(16).status is SampleStatus.BATCH)
        redis_server.close()
        with pytest.raises(BusUnavailable):
            bus.ack(0)
        wait_until(lambda: running.process.waiting_for() == "redis")
        started = time.monotonic()
        for _ in range(40):  # past several looks at the bus that is away
            assert client.sample(16).status is SampleStatus.BATCH
            time.sleep(0.05)
        assert time.monotonic() - started < 10.0
        redis_server.start()  # empty: it keeps no files
        wait_until(lambda: bus.ack(0) is not None)
        assert redis_server.process is not None
        os.kill(redis_server.process.pid, signal.SIGSTOP)  # it does not answer, either
        began, served = time.monotonic(), 0
        while (now := time.monotonic()) < began + 2.5 * TIMEOUT_SECONDS:
            assert client.sample(16).status is SampleStatus.BATCH
            served += time.monotonic() - now < 1.0
        os.kill(redis_server.process.pid, signal.SIGCONT)
        assert served > 40
        wait_until(lambda: bus.ack(0) is not None)  # acks and address are said again
        wait_until(lambda: bus.replay_address("replay") is not None)
        sender.greet()
        sender.send(3)
        wait_until(lambda: running.server.stats()["windows"] == 43)
        assert running.server.stats()["entry_gaps"] == 0
        client.close()
    finally:
        running.end()
        redis_server.close()
