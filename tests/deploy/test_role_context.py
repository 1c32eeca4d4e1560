"""How a role finds its run, and waits for a Redis that is away or full."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import redis

from rmc.common.bus.protocol import EntryId
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.env.config import EnvConfig
from rmc.common.errors import BusFull, ConfigError
from rmc.common.process.role import TERMINATED_STATUS, StopSignal
from rmc.common.shard import Shard
from rmc.deploy.local.replay_process import drop_unread
from rmc.deploy.local.role_context import RoleContext, RunConnection, until_taken
from rmc.deploy.redis import connect as connecting
from rmc.deploy.redis.connect import Deadline, connect
from rmc.deploy.redis.registration import Registration
from rmc.deploy.redis.server import RedisServer
from rmc.deploy.redis.users import RedisUsers
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.presets import debug
from tests.raising import raising
from tests.waiting import wait_until


def test_a_role_waits_for_a_redis_that_is_coming_back(short: Path, caplog: pytest.LogCaptureFixture) -> None:
    server, url = RedisServer(short), f"unix://{short}/redis.sock"
    with pytest.raises(ConfigError, match="no Redis answers"):
        connect(url, "run")
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(connect, url, "run", Deadline(20.0, StopSignal()))
        wait_until(lambda: caplog.messages)
        with server:
            waiting.result().ping()
    (message,) = caplog.messages
    assert message.startswith(f"waiting up to 20 s for the Redis at unix://{short}/redis.sock: ")


@pytest.mark.usefixtures("handlers")
def test_one_that_is_ended_while_it_waits_says_so(short: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RMC_PATIENCE", "60")
    monkeypatch.setattr(connecting, "RECONNECT_SLEEP", 0.0)
    monkeypatch.setattr(connecting.log, "warning", lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    with pytest.raises(SystemExit) as ended:
        RoleContext(RunConnection("run", f"unix://{short}/redis.sock"))
    assert ended.value.code == TERMINATED_STATUS


@pytest.mark.usefixtures("handlers")
def test_a_role_waits_for_its_run(
    redis_url: str, run_name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RMC_PATIENCE", "0.3")
    place = RunConnection(run_name, redis_url)
    with pytest.raises(ConfigError, match=f"--run='{run_name}': no run of this name is registered"):
        RoleContext(place)
    assert caplog.messages == [f"waiting up to 0.3 s for run {run_name} to be registered in that Redis"]
    monkeypatch.setenv("RMC_PATIENCE", "60")
    config = debug(EnvConfig("Pendulum-v1"))
    with ThreadPoolExecutor(1) as pool:
        bus, folder = RedisBus(redis_url, run_name), RunFolder(tmp_path)
        later = pool.submit(lambda: (time.sleep(0.5), Registration(config, folder, bus)))
        assert RoleContext(place).config == config
        later.result()


@pytest.mark.usefixtures("handlers")
def test_a_role_of_a_run_that_has_ended_begins_nothing(
    redis_url: str, run_name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Its launcher has seen to it that nothing of the run stays in Redis."""
    bus = RedisBus(redis_url, run_name)
    Registration(debug(EnvConfig("Pendulum-v1")), RunFolder(tmp_path), bus)
    bus.request_stop("finished")
    with pytest.raises(SystemExit) as ended:
        RoleContext(RunConnection(run_name, redis_url))
    assert (ended.value.code, caplog.messages) == (0, [f"run {run_name} has ended: finished"])


def test_who_is_told_to_stop_waits_no_longer(short: Path, caplog: pytest.LogCaptureFixture) -> None:
    stop = StopSignal()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(connect, f"unix://{short}/redis.sock", "run", Deadline(60.0, stop))
        wait_until(lambda: caplog.messages)
        stop.request()
        with pytest.raises(ConfigError, match="no Redis answers"):
            waiting.result(10.0)


def test_a_url_is_read_from_a_file(short: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the login that the server asks for, and the end of line that every editor writes."""
    users = RedisUsers("run", b"of the run", ("actor-0",))
    with RedisServer(short, users=users) as server:
        (short / "redis-url").write_text(f"{server.url('actor-0')}\n")
        monkeypatch.setenv("HOME", str(short))
        connect("file:~/redis-url", "run").ping()
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


@pytest.mark.usefixtures("handlers")
def test_a_role_that_is_being_made_waits_for_redis(short: Path, run_name: str, tmp_path: Path) -> None:
    config, server = debug(EnvConfig("Pendulum-v1")), RedisServer(short)
    with server:
        bus = RedisBus(server.url(), run_name)
        Registration(config, RunFolder(tmp_path), bus)
        process = RoleContext(RunConnection(run_name, server.url()))
        with process.starting("learner"), ThreadPoolExecutor(1) as pool:  # with whose thread the server ends
            server.close()
            later = pool.submit(lambda: (time.sleep(1.0), server.start()))
            assert process.bus.take_epoch("learner") == 1
            later.result()
            assert bus.current_epoch("learner") == 1


def test_without_room_it_waits(short: Path, caplog: pytest.LogCaptureFixture) -> None:
    with RedisServer(short) as server, redis.Redis.from_url(server.url()) as client:
        client.config_set("maxmemory", 1)
        stop = StopSignal()
        stop.request()
        bus = connect(server.url(), "run")
        with pytest.raises(BusFull):
            until_taken(lambda: bus.check_room("learner"), "learner", stop)  # it is stopped, so it does not wait
        roomy = f"import redis, time; time.sleep(1); redis.Redis.from_url({server.url()!r}).config_set('maxmemory', 0)"
        later = subprocess.Popen([sys.executable, "-c", roomy])
        began = time.monotonic()
        until_taken(lambda: bus.check_room("learner"), "learner", StopSignal())
        assert later.wait(10) == 0
        assert time.monotonic() - began > 0.9
        assert bus.current_epoch("learner") == 0  # nothing was taken meanwhile
    assert [record.getMessage().split(":")[0] for record in caplog.records] == ["learner"] * 2


@pytest.mark.usefixtures("handlers")
def test_a_replay_server_begins_though_its_actors_windows_fill_redis(
    short: Path, run_name: str, tmp_path: Path
) -> None:
    """Nobody else would remove them."""
    config = debug(EnvConfig("Pendulum-v1"))
    with RedisServer(short) as server, redis.Redis.from_url(server.url()) as client:
        bus = RedisBus(server.url(), run_name)
        Registration(config, RunFolder(tmp_path), bus)
        for seq in range(9):
            bus.append(0, EntryId(bus.take_epoch("actor-0") if seq == 0 else 1, seq), bytes(1 << 20))
        client.config_set("maxmemory", client.info()["used_memory"] - 1)
        process, shard = RoleContext(RunConnection(run_name, server.url())), Shard()
        with process.starting("replay", lambda: drop_unread(process.bus, shard)):
            assert process.bus.take_epoch("replay") == 1
        assert list(bus.read({0: EntryId(1, -1)}, 9)) == []


def test_one_that_answers_that_it_is_full_is_there(short: Path) -> None:
    with RedisServer(short) as server:
        bus = RedisBus(server.url(), "run")
        full = "MISCONF Errors writing to the AOF file: No space left on device"
        bus.redis.ping = raising(redis.exceptions.ResponseError(full))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("rmc.deploy.redis.connect.RedisBus", lambda url, run: bus)
            assert connect(server.url(), "run") is bus
