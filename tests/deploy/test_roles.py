"""How a role finds its run, and waits for a Redis that is away or full."""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import redis

from common.errors import ConfigError
from common.redis_bus import RedisBus
from common.role import StopSignal
from deploy.redis_server import RedisServer
from deploy.roles import connect, wait_for_room


@pytest.fixture
def short() -> Iterator[Path]:
    """A folder; pytest's own are too long for a socket's path."""
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def test_a_role_waits_for_a_redis_that_is_coming_back(short: Path) -> None:
    server, url = RedisServer(short), f"unix://{short}/redis.sock"
    with pytest.raises(ConfigError, match="no Redis answers"):
        connect(url, "run")
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(connect, url, "run", 20.0)
        time.sleep(0.7)
        with server:
            waiting.result().ping()


def test_without_room_it_waits(short: Path, caplog: pytest.LogCaptureFixture) -> None:
    with RedisServer(short) as server, redis.Redis.from_url(server.url()) as client:
        client.config_set("maxmemory", 1)
        stop = StopSignal()
        stop.request()
        bus = connect(server.url(), "run")
        wait_for_room(bus, "learner", stop)  # it is stopped, so it does not wait
        roomy = f"import redis, time; time.sleep(1); redis.Redis.from_url({server.url()!r}).config_set('maxmemory', 0)"
        later = subprocess.Popen([sys.executable, "-c", roomy])
        began = time.monotonic()
        wait_for_room(bus, "learner", StopSignal())
        assert later.wait(10) == 0
        assert time.monotonic() - began > 0.9
        assert bus.current_epoch("learner") == 0  # nothing was taken meanwhile
    assert [record.getMessage().split(":")[0] for record in caplog.records] == ["learner"] * 2


def test_one_that_answers_that_it_is_full_is_there(short: Path) -> None:
    with RedisServer(short) as server:
        bus = RedisBus(server.url(), "run")

        def full(*words: object) -> None:
            raise redis.exceptions.ResponseError("MISCONF Errors writing to the AOF file: No space left on device")

        bus._redis.ping = full
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("deploy.roles.RedisBus", lambda url, run: bus)
            assert connect(server.url(), "run") is bus
