"""The embedded server: private, portless, gone with its parent."""

import signal
import socket
import stat
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
import redis

from rmc.common.errors import ConfigError
from rmc.deploy.redis.server import MAX_VALUE, Port, RedisServer, server_binary
from rmc.deploy.redis.users import RedisUsers
from tests.processes import alive
from tests.raising import raising
from tests.waiting import wait_until

HOLDER = """
import sys, time
from pathlib import Path
from rmc.deploy.redis.server import RedisServer
server = RedisServer(Path(sys.argv[1]))
server.start()
print(server.process.pid, flush=True)
time.sleep(60)
"""


def test_listens_on_its_socket_only(tmp_path: Path) -> None:
    with RedisServer(tmp_path) as server:
        client = redis.Redis.from_url(server.url())
        assert client.config_get("port")["port"] == "0"
        assert client.config_get("maxmemory-policy")["maxmemory-policy"] == "noeviction"
        assert stat.S_IMODE(server.socket.stat().st_mode) == 0o700
        assert server.process is not None
        assert not psutil.Process(server.process.pid).net_connections(kind="inet")
        client.close()
    assert not server.socket.exists()


def test_dies_with_its_parent(tmp_path: Path) -> None:
    owner = subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None
    server = psutil.Process(int(owner.stdout.readline()))
    owner.send_signal(signal.SIGKILL)
    owner.wait()
    owner.stdout.close()
    wait_until(lambda: not alive([server]), 5.0)


def test_takes_no_larger_value_than_a_role_may_need(tmp_path: Path) -> None:
    with RedisServer(tmp_path) as server, redis.Redis.from_url(server.url()) as client:
        assert client.set("large", bytes(MAX_VALUE))
        with pytest.raises(redis.exceptions.RedisError), redis.Redis.from_url(server.url(), retry=None) as liar:
            liar.set("larger", bytes(MAX_VALUE + 1))
        assert client.keys() == [b"large"]


@pytest.mark.parametrize(
    ("told", "is_taken"), [("Redis server v=6.0.16 sha=0", False), ("Valkey server v=8.1.0", True)]
)
def test_one_on_the_path_is_taken_unless_it_is_too_old(
    told: str, is_taken: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "redis-server"
    script.write_text(f"#!/bin/sh\necho '{told}'\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert (server_binary() == str(script)) == is_taken


def test_long_path_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"TMPDIR=.*10\d bytes"):
        RedisServer(tmp_path / ("x" * 120))


def test_failed_start_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmc.deploy.redis.server.MAXMEMORY", -1)
    with pytest.raises(ConfigError, match="did not start"):
        RedisServer(tmp_path).start()


def test_one_for_other_machines_that_does_not_start_names_no_url(tmp_path: Path) -> None:
    """Ray takes none."""
    why = r"Warning: Could not create server TCP .*: bind: Address already in use; Failed listening on port .*"
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = Port("127.0.0.1", taken.getsockname()[1])
        server = RedisServer(tmp_path, port, RedisUsers("run", b"secret", ("learner",)))
        with pytest.raises(ConfigError, match=rf"^--launcher='ray': [^#]* \({why}\); mend that, and start again$"):
            server.start()


def test_one_that_cannot_be_started_again_now_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with RedisServer(tmp_path) as server:
        assert server.process is not None
        server.process.kill()
        server.process.wait()
        with monkeypatch.context() as patched:
            patched.setattr(subprocess, "Popen", raising(OSError(12, "Cannot allocate memory")))
            server.tend()
            server.tend()
        assert sum("trying again" in message for message in caplog.messages) == 2
        server.tend()
        with redis.Redis.from_url(server.url()) as client:
            assert client.ping()
