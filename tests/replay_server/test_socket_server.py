"""The socket: who may speak, what they may say, and that nobody's fault is another's."""

import os
import resource
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from rmc.common.errors import AuthenticationError, ConfigError, FencedError, MessageError
from rmc.common.replay import Sample, SampleStatus
from rmc.common.shared_batches import TURNS
from rmc.common.wire import HEADER, MAGIC, VERSION, Kind, decode_header, decode_meta, encode_frame, proof
from rmc.learner.replay.client import ReplayClient
from rmc.learner.replay.connection import ReplayConnection
from rmc.replay_server import socket_server
from rmc.replay_server.config import ReplayConfig
from rmc.replay_server.socket_server import SocketServer
from tests.replay_server import served as served_module
from tests.replay_server.served import BIG, MAX_BATCH, SECRET, Served
from tests.replay_server.support import SPEC, make_rows, write_steps
from tests.waiting import wait_until

Serve = Callable[..., Served]
Frame = Callable[[bytes], tuple[Kind, dict[str, Any]]]  # of a client's nonce
FREE = ReplayConfig(capacity=5000, replay_ratio=1e9, warmup_steps=0)


@pytest.fixture
def serve(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serve]:
    started: list[Served] = []

    def build(config: ReplayConfig = FREE, address: str = "", windows: int = 200, total: int = 10**9) -> Served:
        folder = tmp_path_factory.mktemp("s")
        started.append(Served(folder / "replay", address or f"unix:{folder}/r.sock", config, windows, total))
        return started[-1]

    yield build
    for served in started:
        served.close()


def draw(connection: ReplayConnection, batch_size: int = 32) -> tuple[Kind, np.ndarray, np.ndarray]:
    connection.send(Kind.SAMPLE, {"batch_size": batch_size, "elsewhere": 0})
    return receive(connection, batch_size)


def receive(connection: ReplayConnection, batch_size: int) -> tuple[Kind, np.ndarray, np.ndarray]:
    header, _, body = connection.receive(memoryview(bytearray(BIG)))
    split = batch_size * SPEC.dtype.itemsize if header.kind is Kind.BATCH else 0
    return header.kind, np.frombuffer(body[:split], SPEC.dtype), np.frombuffer(body[split:], np.float64)


def works(served: Served) -> None:
    """A lawful client is served at once."""
    connection = served.connect()
    started = time.monotonic()
    kind, rows, _ = draw(connection)
    assert kind is Kind.BATCH
    assert len(rows) == 32
    assert time.monotonic() - started < 1.0
    connection.close()


@pytest.mark.parametrize("address", ["", "tcp:127.0.0.1:0"])
def test_pipelined_draws_are_what_a_server_in_the_same_thread_gives(serve: Serve, address: str) -> None:
    served, twin = serve(address=address), serve()
    connection = served.connect()
    for _ in range(5):
        connection.send(Kind.SAMPLE, {"batch_size": 64, "elsewhere": 0})
    for _ in range(5):
        kind, rows, values = receive(connection, 64)
        sample = twin.replay.sample(64)
        assert kind is Kind.BATCH
        assert sample.rows is not None
        assert rows.tobytes() == sample.rows.tobytes()
        assert np.array_equal(values, sample.weights)
    connection.close()


@pytest.mark.parametrize("address", ["", "tcp:127.0.0.1:0"])
@pytest.mark.parametrize("pinned", [False, True])
def test_the_learners_client_gets_the_same_draws_however_they_come(serve: Serve, address: str, pinned: bool) -> None:
    served, twin = serve(address=address), serve()
    client = ReplayClient(lambda: served.address, SECRET, SPEC, 64)
    client._may_share = client._may_share and not pinned  # pinned buffers need a device
    before = None
    for _ in range(3 * TURNS):
        sample, expected = client.sample(64), twin.replay.sample(64)
        assert sample.rows is not None
        assert expected.rows is not None
        assert np.array_equal(sample.weights, expected.weights)
        if before is not None:  # a batch stays what it is until the next draw but one
            assert before[0].tobytes() == before[1]
        before = sample.rows, expected.rows.tobytes()
        assert before[0].tobytes() == before[1]
    assert (client._shared is not None) == (not pinned and not address and hasattr(os, "memfd_create"))
    client.close()


def test_memory_is_shared_once_and_with_this_machine_alone(serve: Serve) -> None:
    near, far = serve(), serve(address="tcp:127.0.0.1:0")
    twice, remote = near.connect(), far.connect()
    assert (twice.share(SPEC, 8) is not None) == hasattr(os, "memfd_create")
    kind, rows, _ = draw(twice, 16)  # of another size than is shared
    assert (kind, len(rows)) == (Kind.BATCH, 16)
    for served, connection in ((near, twice), (far, remote)):
        connection.send(Kind.SHARE, {"batch_size": 8})
        served.refused("kind")
        connection.close()


def test_priorities_and_statistics(serve: Serve) -> None:
    served = serve()
    connection = served.connect()
    serials, priorities = np.array([0, 7, 10**6], np.int64), np.array([2, 5, 9], np.float32)
    connection.send(Kind.PRIORITIES, {"count": 3}, (serials.tobytes(), priorities.tobytes()))
    connection.send(Kind.STATISTICS, {})
    header, _, body = connection.receive(memoryview(bytearray(BIG)))
    expected = served.replay.statistics()
    assert header.kind is Kind.STATISTICS
    assert expected.count.tolist() == [200 * SPEC.train]
    assert bytes(body) == b"".join(x.tobytes() for x in (expected.count, expected.total, expected.total_square))
    stats = served.replay.stats()
    assert stats["evicted_priorities"] == 1
    assert stats["max_priority"] == 5.0
    assert stats["windows"] == 200
    assert served.replay._store.priorities[[0, 7]].tolist() == [2.0, 5.0]
    connection.close()


def test_an_episode_over_the_socket(serve: Serve) -> None:
    served = serve()
    rows = make_rows(3)
    rows["episode_step"] = np.arange(3) * SPEC.train
    write_steps(rows, [0, 0, 0])
    served.sender.send_rows(rows)
    while served.replay.step():
        pass
    connection = served.connect()
    for serial, expected in ((202, [200, 201, 202]), (200, [200]), (203, [])):
        connection.send(Kind.EPISODE, {"serial": serial})
        header, meta, body = connection.receive(memoryview(bytearray(BIG)))
        assert (header.kind, meta["count"]) == (Kind.EPISODE, len(expected))
        assert np.frombuffer(body, SPEC.dtype)["serial"].tolist() == expected
    connection.send(Kind.EPISODE, {"serial": "202"})
    header, meta = connection.receive_small()
    assert header.kind is Kind.ERROR
    assert "serial: '202'" in meta["error"]
    connection.close()


def test_wait_is_said_at_once_and_finished_at_the_end(serve: Serve) -> None:
    waiting = serve(ReplayConfig(capacity=500, replay_ratio=1.0, warmup_steps=10**6)).connect()
    assert [draw(waiting)[0] for _ in range(3)] == [Kind.WAIT] * 3
    waiting.close()
    ending = serve(ReplayConfig(capacity=500, replay_ratio=2.0, warmup_steps=0), windows=100, total=400).connect()
    kinds = [draw(ending, 10)[0] for _ in range(22)]
    assert kinds == [Kind.BATCH] * 20 + [Kind.FINISHED] * 2  # 400 steps * 2 / (10 windows of 4)
    ending.close()


def test_a_client_with_another_secret_is_refused(serve: Serve) -> None:
    served = serve()
    with pytest.raises((AuthenticationError, ConnectionError)):
        served.connect(b"another secret")
    served.refused("authentication")
    works(served)


@pytest.fixture
def impostor(tmp_path: Path) -> Iterator[Callable[[Frame], str]]:
    """Takes a dead server's address: it challenges whoever comes, and answers their nonce with that frame."""
    listener, stack = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM), ExitStack()
    listener.bind(f"{tmp_path}/r.sock")
    listener.listen()

    def serve_one(frame: Frame) -> None:
        accepted, _ = listener.accept()
        with accepted:
            accepted.sendall(encode_frame(Kind.CHALLENGE, {"nonce": b"c" * 32}))
            raw = accepted.recv(4096)
            header = decode_header(raw[: HEADER.size], 0)
            meta = decode_meta(raw[HEADER.size :], b"", header)
            accepted.sendall(encode_frame(*frame(meta["nonce"])))

    def start(frame: Frame) -> str:
        def loop() -> None:
            with suppress(OSError):  # closed
                while True:
                    serve_one(frame)

        thread = threading.Thread(target=loop)
        thread.start()
        stack.callback(thread.join)
        stack.callback(listener.close)
        stack.callback(listener.shutdown, socket.SHUT_RDWR)
        return f"unix:{tmp_path}/r.sock"

    yield start
    stack.close()


def test_a_server_with_another_secret_is_refused(impostor: Callable[[Frame], str]) -> None:
    def frame(nonce: bytes) -> tuple[Kind, dict[str, Any]]:
        answer = proof(b"a guess", b"server", nonce, b"c" * 32)
        return Kind.WELCOME, {"proof": answer, "fingerprint": SPEC.fingerprint}

    with pytest.raises(AuthenticationError, match="does not know this run's secret"):
        ReplayConnection(impostor(frame), SECRET, SPEC.fingerprint, BIG)


@pytest.mark.parametrize(
    "fenced",
    [
        lambda nonce: True,
        lambda nonce: proof(b"a guess", b"fenced", nonce, b"c" * 32),
        lambda nonce: proof(SECRET, b"fenced", b"n" * 32, b"c" * 32),  # of another connection, heard there
    ],
)
def test_who_proves_nothing_ends_no_learner(
    serve: Serve, impostor: Callable[[Frame], str], fenced: Callable[[bytes], Any], caplog: pytest.LogCaptureFixture
) -> None:
    def frame(nonce: bytes) -> tuple[Kind, dict[str, Any]]:
        return Kind.ERROR, {"error": "the learner of epoch 4 was replaced by 5", "fenced": fenced(nonce)}

    addresses = [impostor(frame)]
    client = ReplayClient(lambda: addresses[-1], SECRET, SPEC, 8)
    assert [client.sample(8).status for _ in range(3)] == [SampleStatus.WAIT] * 3
    assert len([record for record in caplog.records if "is away: it said" in record.message]) == 1
    assert client.statistics() is None
    assert client.episode(0) is None
    addresses.append(serve().address)
    assert client.sample(8).status is SampleStatus.BATCH
    client.close()


@pytest.mark.parametrize("total_weight", ["x", None, [], True, float("nan"), float("inf"), -1.0])
def test_a_draw_of_no_mass_is_an_outage(serve: Serve, total_weight: Any, caplog: pytest.LogCaptureFixture) -> None:
    away_for(serve(), Sample(SampleStatus.WAIT, None, None, total_weight, 12, 0), "total_weight", caplog)


@pytest.mark.parametrize("count", ["3", None, {}, True, float("nan"), float("inf"), 1.5, -1])
def test_a_draw_of_no_counters_is_an_outage(serve: Serve, count: Any, caplog: pytest.LogCaptureFixture) -> None:
    away_for(serve(), Sample(SampleStatus.WAIT, None, None, 1.0, count, 0), "env_steps", caplog)


def away_for(served: Served, sample: Sample, reason: str, caplog: pytest.LogCaptureFixture) -> None:
    """The client waits, and says once why."""
    lawful, client = served.replay.sample, served.client(0)
    served.replay.sample = lambda *_: sample  # type: ignore[method-assign]
    assert [client.sample(8).status for _ in range(3)] == [SampleStatus.WAIT] * 3
    (message,) = [record.message for record in caplog.records if "is away" in record.message]
    assert f"is away: {reason}: " in message
    served.replay.sample = lawful  # type: ignore[method-assign]
    assert client.sample(8).status is SampleStatus.BATCH
    client.close()


@pytest.mark.parametrize(
    "address",
    ["tcp:127.0.0.1:no", "tcp:127.0.0.1:99999", "unix:a\0b", "tcp:a\0b:1", "tcp:" + "x" * 99 + ":1", "3 unix:/a"],
)
def test_an_address_that_is_none_is_an_outage(address: str) -> None:
    client = ReplayClient(lambda: address, SECRET, SPEC, 8)
    assert client.sample(8).status is SampleStatus.WAIT
    assert client.statistics() is None


def test_a_replaced_learner_reads_and_writes_nothing_more(serve: Serve) -> None:
    served = serve()
    old, new = served.client(4), served.client(5)
    sample = old.sample(8)
    assert sample.rows is not None
    serials = sample.rows["serial"].copy()
    assert old.statistics().count > 0  # by its other connection
    assert new.sample(8).rows is not None
    served.refused("fenced")
    old.update_priorities(serials, np.full(8, 1e6, np.float32))
    with pytest.raises(FencedError, match="the learner of epoch 4 was replaced by 5"):
        deque(old.sample(8) for _ in range(4))  # what was drawn ahead is still there; then at the latest
    with pytest.raises(FencedError):
        old.statistics()
    with pytest.raises(FencedError):
        served.connect(epoch=4)
    assert served.replay.stats()["max_priority"] == 1.0
    again = served.connect(epoch=5)
    assert draw(again)[0] is Kind.BATCH
    for client in (old, new, again):
        client.close()


@pytest.mark.parametrize("epoch", [-1, "5", True, None, 1.0, 2**63])
def test_what_is_no_epoch_is_refused(serve: Serve, epoch: Any) -> None:
    served = serve()
    with pytest.raises(AuthenticationError, match="is no learner's epoch"):
        served.connect(epoch=epoch)
    works(served)


def test_a_proof_cannot_be_used_again_or_turned_round(serve: Serve) -> None:
    served, nonce = serve(), os.urandom(32)
    for side, challenge in ((b"client", b"an older challenge".ljust(32)), (b"server", b"")):
        raw = served.stranger()
        raw.sendall(encode_frame(Kind.PROOF, {"nonce": nonce, "proof": proof(SECRET, side, challenge, nonce)}))
        assert b"does not know" in raw.recv(4096)
        raw.close()
    assert served.sockets.refused["authentication"] == 2


@pytest.mark.parametrize(
    ("sent", "reason"),
    [
        (os.urandom(200), "version"),
        (HEADER.pack(MAGIC, VERSION, Kind.PROOF, 0, 10, 0, 1 << 60), "too-large"),
        (HEADER.pack(MAGIC, VERSION, Kind.PROOF, 0, 1 << 20, 0, 0), "too-large"),
        (HEADER.pack(MAGIC, VERSION, 200, 0, 0, 0, 0), "kind"),
        (HEADER.pack(MAGIC, VERSION, Kind.PROOF, 0, 3, 12345, 0) + b"abc", "crc"),
        (encode_frame(Kind.SAMPLE, {"batch_size": 4}), "authentication"),
        (encode_frame(Kind.PROOF, {"nonce": "text", "proof": 3}), "authentication"),
        (encode_frame(Kind.PROOF, {"nonce": b"n" * 32, "proof": [1]}), "authentication"),
    ],
)
def test_a_stranger_who_talks_nonsense(serve: Serve, sent: bytes, reason: str) -> None:
    served = serve()
    raw = served.stranger()
    raw.sendall(sent)
    served.refused(reason)
    raw.close()
    works(served)


@pytest.mark.parametrize(
    ("sent", "reason"),
    [
        (b"x" * 100, "version"),
        (HEADER.pack(MAGIC, VERSION, Kind.PRIORITIES, 0, 5, 0, 12 * MAX_BATCH + 1), "too-large"),
        (encode_frame(Kind.SAMPLE, {"batch_size": MAX_BATCH + 1}), "batch-size"),
        (encode_frame(Kind.SAMPLE, {"batch_size": True}), "batch-size"),
        (encode_frame(Kind.SAMPLE, {"batch_size": 8}), "elsewhere"),
        (encode_frame(Kind.SAMPLE, {"batch_size": 8, "elsewhere": -1}), "elsewhere"),
        (encode_frame(Kind.SAMPLE, {}), "batch-size"),
        (encode_frame(Kind.SHARE, {"batch_size": 0}), "batch-size"),
        (encode_frame(Kind.SHARE, {"batch_size": MAX_BATCH + 1}), "batch-size"),
        (encode_frame(Kind.PRIORITIES, {"count": 3}, (b"1234",)) + b"1234", "length"),
        (encode_frame(Kind.PRIORITIES, {"count": -1}), "length"),
        (encode_frame(Kind.WELCOME, {}), "kind"),
        (HEADER.pack(MAGIC, VERSION, Kind.STATISTICS, 0, 1, 0x1D41B76, 0) + b"\xc1", "crc"),
    ],
)
def test_a_client_who_lies_loses_only_its_own_connection(serve: Serve, sent: bytes, reason: str) -> None:
    served = serve()
    liar, other = served.connect(), served.connect()
    liar._socket.sendall(sent)
    served.refused(reason)
    assert draw(other)[0] is Kind.BATCH
    liar.close()
    other.close()
    works(served)


def test_half_a_header_or_half_a_body_keeps_nobody_waiting(serve: Serve) -> None:
    served = serve()
    half, halved = served.stranger(), served.connect()
    half.sendall(MAGIC)
    halved._socket.sendall(HEADER.pack(MAGIC, VERSION, Kind.PRIORITIES, 0, 8, 0, 120) + b"\x81\xa5coun")
    works(served)
    half.close()
    halved.close()
    works(served)


def test_a_client_that_does_not_read_keeps_nobody_waiting_and_gets_its_own_batch(serve: Serve) -> None:
    config = ReplayConfig(capacity=60_000, replay_ratio=1e9, warmup_steps=0, priority_exponent=1.0)
    served = serve(config, windows=3000)
    silent, busy = served.connect(), served.connect()
    serials = np.arange(3000)
    priorities = 1.0 + serials.astype(np.float32)
    silent.send(Kind.PRIORITIES, {"count": 3000}, (serials.tobytes(), priorities.tobytes()))
    silent._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    for _ in range(30):  # more than the kernel's buffers take
        silent.send(Kind.SAMPLE, {"batch_size": MAX_BATCH, "elsewhere": 0})
    for _ in range(20):
        assert draw(busy, MAX_BATCH)[0] is Kind.BATCH  # each takes the buffer that a batch unsent may lie in
    for _ in range(30):
        kind, rows, weights = receive(silent, MAX_BATCH)
        assert kind is Kind.BATCH
        assert (rows["reward"][:, 0] == rows["serial"]).all()
        assert np.array_equal(weights, 1.0 + rows["serial"])  # all whole rows have one CRC: these are the draw's own
    silent.close()
    busy.close()


def test_priorities_of_large_batches_never_wait_for_the_batches(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both ends send more than the kernel's buffers take."""
    monkeypatch.setattr(served_module, "MAX_BATCH", 40_000)
    served = serve()
    client = ReplayClient(lambda: served.address, SECRET, SPEC, 40_000)
    client._may_share = False
    started = time.monotonic()
    for _ in range(4):
        sample = client.sample(40_000)
        assert sample.rows is not None
        client.update_priorities(sample.rows["serial"], np.ones(40_000, np.float32))
    assert time.monotonic() - started < 8.0  # a socket gives up after 10 s
    client.close()


def test_strangers_are_sent_away_and_cannot_fill_the_server(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket_server, "AUTHENTICATION_SECONDS", 0.3)
    served = serve()
    unauthenticated = []
    for _ in range(socket_server.MAX_CONNECTIONS):
        unauthenticated.append(served.stranger())
    works(served)  # the oldest stranger makes room for it
    assert served.sockets.refused["too-many"] == 1
    assert unauthenticated[0].recv(1) == b""
    served.refused("silent")
    for raw in unauthenticated:
        raw.close()


def until_works(served: Served) -> None:
    """As soon as the listener's queue has room; a client tries again, too."""
    deadline = time.monotonic() + 5.0
    while True:
        try:
            works(served)
            return
        except BlockingIOError:
            assert time.monotonic() < deadline
            time.sleep(0.01)


def test_a_thousand_strangers_stop_no_batch(serve: Serve) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(hard, 4096)), hard))
    served, crowd = serve(), ExitStack()
    learner = crowd.enter_context(closing(served.connect()))

    def throng() -> None:
        for number in range(1000):
            raw = crowd.enter_context(closing(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)))
            raw.connect(served.address.removeprefix("unix:"))
            raw.send(b"\xff" * (number % 40))  # nothing, half a header, or one of a huge length

    with crowd:
        thread = threading.Thread(target=throng)
        thread.start()
        slowest, drawn = 0.0, 0
        while thread.is_alive() or drawn < 100:
            started = time.monotonic()
            assert draw(learner)[0] is Kind.BATCH
            slowest, drawn = max(slowest, time.monotonic() - started), drawn + 1
        thread.join()
        until_works(served)
        assert slowest < 1.0
        assert served.sockets.refused.total() > 900


def test_strangers_do_not_fill_the_log(serve: Serve, caplog: pytest.LogCaptureFixture) -> None:
    """The same of each is said once, and counted; what authenticated clients do is always said."""
    served = serve()
    for count in range(1, 4):
        with closing(served.stranger()) as raw:
            raw.sendall(b"x" * 100)
            wait_until(lambda count=count: served.sockets.refused["version"] == count, 5.0)
    assert caplog.text.count("a client was refused") == 1
    for count in range(1, 3):
        with closing(served.connect()) as liar:
            liar._socket.sendall(encode_frame(Kind.SHARE, {"batch_size": 0}))
            wait_until(lambda count=count: served.sockets.refused["batch-size"] == count, 5.0)
    assert caplog.text.count("a client was refused") == 3


def test_a_client_of_other_windows_is_told(serve: Serve) -> None:
    served = serve()
    with pytest.raises(MessageError, match="fingerprint"):
        ReplayConnection(served.address, SECRET, "0" * 16, BIG)


def test_the_learners_client_finds_a_restarted_server_again(serve: Serve) -> None:
    addresses: list[str] = []
    client = ReplayClient(lambda: addresses[-1] if addresses else None, SECRET, SPEC, 16)
    assert client.sample(16).status is SampleStatus.WAIT
    for _ in range(2):
        served = serve()
        addresses.append(served.address)
        all_works(client, served)
        served.close()
        served.close = lambda: None  # type: ignore[method-assign]
    assert client.sample(16).status in (SampleStatus.WAIT, SampleStatus.BATCH)
    client.close()


def all_works(client: ReplayClient, served: Served) -> None:
    """Draws, one of them ahead, priorities, statistics and episodes, once the client has found it."""
    draws = [client.sample(16) for _ in range(6)]
    assert [sample.status for sample in draws[2:]] == [SampleStatus.BATCH] * 4
    assert draws[-1].env_steps == 200 * SPEC.train
    wait_until(lambda: served.replay.stats()["drawn_steps"] > draws[-1].drawn_steps, 5.0)
    client.update_priorities(np.arange(16), np.full(16, 3.0, np.float32))
    statistics = client.statistics()
    assert statistics is not None
    assert statistics.count == 200 * SPEC.train
    wait_until(lambda: served.replay._store.priorities[15] == 3.0, 5.0)  # went out before the question
    episode = client.episode(7)  # every window here is an episode of its own
    assert episode is not None
    assert episode["serial"].tolist() == [7]
    assert client.episode(999) is None


def test_it_listens_on_the_interface_named_alone(serve: Serve) -> None:
    served = serve(address="tcp:127.0.0.1:0")
    port = int(served.address.rpartition(":")[2])
    own = [
        address.address
        for each in psutil.net_if_addrs().values()
        for address in each
        if address.family == socket.AF_INET
    ]
    for other in {"127.0.0.2", *own} - {"127.0.0.1"}:
        with pytest.raises(OSError, match=r"refused|assign"), socket.create_connection((other, port), 5.0):
            pass
    works(served)


@pytest.mark.parametrize(
    "address",
    [
        "r.sock",
        "tcp:host",
        "tcp:127.0.0.1:99999",
        "tcp:192.0.2.1:0",
        "tcp:localhost:²",
        "unix:a\0b",
        "unix:/no/such/r.sock",
    ],
)
def test_an_address_that_cannot_be_listened_on(address: str) -> None:
    with pytest.raises(ConfigError, match="replay address"):
        SocketServer(None, address, SECRET, 1)  # type: ignore[arg-type]


def test_a_taken_port_an_old_file_and_an_empty_secret(serve: Serve, tmp_path: Path) -> None:
    served = serve(address="tcp:127.0.0.1:0")
    with pytest.raises(ConfigError, match="the port is taken"):
        SocketServer(served.replay, served.address, SECRET, 1)
    with pytest.raises(ConfigError, match="secret"):
        SocketServer(served.replay, served.address, b"", 1)
    path = tmp_path / "r.sock"
    path.write_text("a thesis")
    with pytest.raises(ConfigError, match="a file is there"):
        SocketServer(served.replay, f"unix:{path}", SECRET, 1)
    assert path.read_text() == "a thesis"
    path.unlink()
    with socket.socket(socket.AF_UNIX) as killed:  # a killed server leaves its socket's file
        killed.bind(str(path))
    again = SocketServer(served.replay, f"unix:{path}", SECRET, 1)
    assert path.stat().st_mode & 0o777 == 0o600
    again.close()
    assert not path.exists()


def test_bytes_one_by_one(serve: Serve) -> None:
    served = serve()
    connection = served.connect()
    for byte in encode_frame(Kind.SAMPLE, {"batch_size": 8, "elsewhere": 0}):
        connection._socket.sendall(struct.pack("B", byte))
        time.sleep(0.001)
    assert receive(connection, 8)[0] is Kind.BATCH
    connection.close()
