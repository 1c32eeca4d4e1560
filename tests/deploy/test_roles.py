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
from deploy.redis_users import RedisUsers
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


def test_a_url_is_read_from_a_file(short: Path) -> None:
    """With the login that the server asks for, and the end of line that every editor writes."""
    users = RedisUsers("run", b"of the run", ("actor-0",))
    with RedisServer(short, users=users) as server:
        (short / "redis-url").write_text(f"{server.url('actor-0')}\n")
        connect(f"file:{short}/redis-url", "run").ping()
        (short / "redis-url").write_text(f"unix://{server.socket}\n")
        with pytest.raises(ConfigError, match=r"--redis-url='unix:///.*no Redis answers there .*authenticat"):
            connect(f"file:{short}/redis-url", "run")


@pytest.mark.parametrize(
    ("content", "named"), [(None, "No such file"), (b"\xff\xfe", "is no text"), (b"hush", "not a")]
)
def test_a_file_that_holds_no_url_is_named_in_one_line(short: Path, content: bytes | None, named: str) -> None:
    if content is not None:
        (short / "redis-url").write_bytes(content)
    with pytest.raises(ConfigError, match=named) as raised:
        connect(f"file:{short}/redis-url", "run")
    assert "\n" not in str(raised.value)
    assert "hush" not in str(raised.value)


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
