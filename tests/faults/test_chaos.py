"""Faults on top of each other, a few seconds of what ``make chaos`` does for hours; and what it is made of."""

import os
import socket
import sys
import time
from contextlib import closing, suppress
from itertools import islice, pairwise
from pathlib import Path

import pytest

from tests.faults.all_at_once import DISK_MB, chaos, judged
from tests.faults.proxy import CALM, Interposed, Proxy, Weather, tcp_proxy
from tests.faults.schedule import KINDS, LAUNCHER, NODE, Fault, schedule
from tests.waiting import wait_until

linux = pytest.mark.skipif(sys.platform != "linux", reason="a fork server, small disks, memory by /proc")
root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a small disk")
SECONDS = 5.5
FAULTS = (
    Fault(0.1, "redis proxy", "bytes", 0.8, 0.0),
    Fault(0.3, "replay proxy", "cut", 2.0, 0.0),
    Fault(0.5, "kill", "actor-1", 0.0, 0.0),
    Fault(0.8, "freeze", "replay", 1.0, 0.0),
    Fault(1.2, "disk full", "run", 1.5, 0.0),
    Fault(1.6, "damage", "rows", 0.0, 0.5),
    Fault(1.9, "kill", "replay", 0.0, 0.0),
    Fault(2.2, "redis proxy", "cut", 1.5, 0.0),
    Fault(2.6, "kill redis", "comes back empty", 0.3, 0.0),
    Fault(3.2, "damage", "metrics.jsonl", 0.0, 0.5),
    Fault(4.0, "freeze", "actor-0", 1.0, 0.0),
    Fault(4.5, "replay proxy", "late", 0.5, 0.0),
)


@root
@linux
def test_faults_overlap(tmp_path: Path) -> None:
    """And nothing is lost. (The name is short, for Redis has a socket below a folder of that name.)"""
    with chaos(tmp_path, tmp_path / "log.jsonl", DISK_MB) as one:
        one.suffer(FAULTS, SECONDS)
        back = one.until_all_go_on()
        one.stop()
        row = judged(one, "all at once", back)
    assert row.passed, row
    assert row.tries == len(FAULTS), (tmp_path / "log.jsonl").read_text()
    assert row.acknowledged is not None
    assert row.acknowledged > 50


def test_a_seed_gives_the_same_faults_again() -> None:
    faults = list(islice(schedule(7, 1.0), 2000))
    assert faults == list(islice(schedule(7, 1.0), 2000)) != list(islice(schedule(8, 1.0), 2000))
    assert {fault.kind for fault in faults} == KINDS.keys()
    assert {fault.target for fault in faults} >= {LAUNCHER, NODE, "learner", "replay", "redis", "checkpoint"}
    assert all(earlier.at <= later.at for earlier, later in pairwise(faults))


def listening(path: Path) -> socket.socket:
    """A unix socket's server, in the place of one before it."""
    path.unlink(missing_ok=True)
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen()
    return listener


def through(proxy: Proxy, path: Path, data: bytes) -> bytes:
    """What arrives of it behind the proxy, before the connection ends."""
    with listening(path) as listener, socket.create_connection(proxy.address) as client:
        server, _ = listener.accept()
        with suppress(ConnectionResetError, BrokenPipeError):
            client.sendall(data)
            client.shutdown(socket.SHUT_WR)
        with server:
            return everything(server)


def everything(connection: socket.socket) -> bytes:
    """Until it ends, however."""
    received = b""
    with suppress(ConnectionResetError):
        while more := connection.recv(65_536):
            received += more
    return received


@pytest.mark.parametrize("weather", [CALM, Weather(piece=1), Weather(late=0.05)])
def test_a_proxy_passes_every_byte(tmp_path: Path, weather: Weather) -> None:
    with closing(tcp_proxy(tmp_path / "server.sock")) as proxy:
        proxy.weather = weather
        data, began = os.urandom(5000), time.monotonic()
        assert through(proxy, tmp_path / "server.sock", data) == data
        assert time.monotonic() - began >= weather.late
        assert (proxy.connections, proxy.cuts) == (1, 0)


def test_a_proxy_cuts_after_any_byte(tmp_path: Path) -> None:
    with closing(tcp_proxy(tmp_path / "server.sock")) as proxy:
        proxy.weather = Weather(cut=1000)
        data = os.urandom(2000)
        received = [through(proxy, tmp_path / "server.sock", data) for _ in range(5)]
        assert all(data.startswith(part) and len(part) < 1000 for part in received)
        assert len({len(part) for part in received}) > 1
        assert proxy.cuts == 5


def test_a_proxy_takes_the_place_of_a_socket_and_of_the_next_one_there(tmp_path: Path) -> None:
    path = tmp_path / "server.sock"
    with closing(Interposed(lambda: path if path.exists() else None)) as proxy:
        for number in range(2):
            with listening(path) as listener, (tmp_path / "file").open("w+b") as file:
                wait_until(lambda before=number: proxy.placed > before)
                with socket.socket(socket.AF_UNIX) as client:
                    client.connect(str(path))
                    server, _ = listener.accept()
                    with server:
                        socket.send_fds(server, [b"here"], [file.fileno()])
                    first, (descriptor,), _, _ = socket.recv_fds(client, 4, 1)
                    assert first + everything(client) == b"here"
                os.write(descriptor, b"written")
                os.close(descriptor)
                file.seek(0)
                assert file.read() == b"written"
    assert proxy.connections == 2
