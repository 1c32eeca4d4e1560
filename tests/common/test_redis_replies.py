"""What a Redis answers in error: waited out where it passes, one line with the key where it does not; real answers."""

import re
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil
import pytest
import redis
from redis.exceptions import ResponseError

from rmc.common.bus import redis_connection
from rmc.common.bus.protocol import Ack, EntryId, ReplayOwner, Version
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.bus.redis_client import refusal
from rmc.common.errors import BusFull, BusUnavailable, ConfigError
from rmc.common.process.role import StopSignal
from rmc.deploy.redis.connect import Deadline, connect
from rmc.deploy.redis.server import RedisServer, server_binary

Call = Callable[[RedisBus], object]
ACK = {0: Ack(EntryId(1, 1), 5)}
READS: dict[str, Call] = {
    "config": lambda bus: bus.config(),
    "actors": lambda bus: bus.actors(),
    "acks": lambda bus: bus.ack(0),
    "progress": lambda bus: bus.progress("replay"),
    "replay": lambda bus: bus.replay_address("replay"),
    "weights": lambda bus: bus.latest_version(),
    "weights:1:1:0": lambda bus: bus.weights(),
    "windows:0": lambda bus: bus.read({0: EntryId(0, 0)}, 10),
    "metrics:learner": lambda bus: bus.records({"learner": "0"}),
    "stop": lambda bus: bus.stop_requested(),
    "epoch:actor-0": lambda bus: bus.current_epoch("actor-0"),
}
WRITES: dict[str, Call] = {
    "config": lambda bus: bus.set_config(b"{}"),
    "windows:0": lambda bus: bus.append(0, EntryId(1, 1), b"x"),
    "metrics:learner": lambda bus: bus.emit("learner", {"updates": 1}),
    "acks": lambda bus: bus.commit(ReplayOwner("replay", 1), ACK, b"x"),
    "epoch:learner": lambda bus: bus.take_epoch("learner"),
    "weights": lambda bus: bus.publish_weights(Version(1, 2), b"two"),
    "stop": lambda bus: bus.request_stop("x"),
    "dead": lambda bus: bus.dead_letter(bus.read({0: EntryId(0, 0)}, 1)[0], "x"),
    "replay": lambda bus: bus.announce_replay(ReplayOwner("replay", 1), "unix:x"),
    "run": lambda bus: bus.expire(60),
}
FAQ = (Path(__file__).parents[2] / "docs" / "faq.md").read_text()
TABLE = FAQ.split("## What a Redis of my own answers")[1].split("\n## ")[0]
ROWS = re.findall(r"^\| (`[A-Z].*?) \|", TABLE, re.MULTILINE)
MEANS = BusUnavailable, BusFull, ConfigError, ConfigError, ConfigError, ConfigError  # of each row of the docs' table
ANSWERS = {code: means for row, means in zip(ROWS, MEANS, strict=True) for code in re.findall(r"[A-Z]+", row)}
del ANSWERS["LOADING"]  # for redis-py a lost connection
OF_ANOTHER_TYPE = {  # a key that somebody made a list, and who stumbles over it
    **{key: call for key, call in READS.items() if key != "weights:1:1:0"},
    "weights:1:1:0": READS["weights:1:1:0"],
    "acks ": WRITES["acks"],
    "windows:0 ": WRITES["windows:0"],
    "metrics:learner ": WRITES["metrics:learner"],
    "epoch:learner": WRITES["epoch:learner"],
    "epoch:learner ": WRITES["weights"],
    "epoch:replay": WRITES["acks"],
    "dead": WRITES["dead"],
    "replay ": WRITES["replay"],
}


@pytest.fixture(scope="module")
def server() -> Iterator[RedisServer]:
    with tempfile.TemporaryDirectory(prefix="rmc-replies-") as folder, RedisServer(Path(folder)) as server:
        yield server


@pytest.fixture
def bus(server: RedisServer, run_name: str) -> RedisBus:
    redis_bus = RedisBus(server.url(), re.sub(r"[^\w-]", "-", run_name))
    redis_bus.set_config(b"{}")
    redis_bus.append(0, EntryId(1, 0), b"hello")
    redis_bus.publish_weights(Version(1, 1), b"weights")
    redis_bus.emit("learner", {"updates": 0})
    return redis_bus


@contextmanager
def busy(server: RedisServer) -> Iterator[None]:
    """Somebody's script runs on and on."""
    client = redis.Redis.from_url(server.url())
    client.config_set("lua-time-limit", 10)

    def run_script() -> None:
        with suppress(redis.exceptions.RedisError):
            redis.Redis.from_url(server.url()).eval("while true do end", 0)

    thread = threading.Thread(target=run_script)
    thread.start()
    try:
        while not _is_busy(client):
            time.sleep(0.01)
        yield
    finally:
        client.execute_command("SCRIPT", "KILL")
        thread.join()


def _is_busy(client: redis.Redis) -> bool:
    try:
        client.ping()
    except redis.exceptions.RedisError:
        return True
    return False


def test_one_that_hangs_amid_a_transaction_costs_one_wait_and_no_connection(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(redis_connection, "TIMEOUT_SECONDS", 2.0)
    with RedisServer(tmp_path) as server:
        bus = RedisBus(server.url(), "run")
        assert server.process is not None
        process = psutil.Process(server.process.pid)

        def freeze(pipe: Any) -> None:
            process.suspend()
            pipe.multi()
            pipe.set("other", 1)

        began = time.monotonic()
        with pytest.raises(BusUnavailable):
            bus.call(lambda: bus.redis.transaction(freeze, "watched"))
        assert time.monotonic() - began < 2 * redis_connection.TIMEOUT_SECONDS
        process.resume()
        assert not bus.redis.connection_pool._in_use_connections
        bus._rests_until = 0.0  # as once it has been left alone for as long as it took
        bus.ping()


@contextmanager
def replica(server: RedisServer, serves_stale_data: str) -> Iterator[None]:
    """A failover has made it a replica of one that it cannot reach."""
    client = redis.Redis.from_url(server.url())
    client.config_set("replica-serve-stale-data", serves_stale_data)
    client.replicaof("127.0.0.1", "1")
    yield
    client.replicaof("NO", "ONE")


@pytest.mark.parametrize("call", [*READS.values(), *WRITES.values()], ids=[*READS, *(f"{key}-write" for key in WRITES)])
def test_busy(server: RedisServer, bus: RedisBus, call: Call) -> None:
    with busy(server), pytest.raises(BusUnavailable, match="BUSY"):
        call(bus)


@pytest.mark.parametrize("call", WRITES.values(), ids=WRITES)
def test_readonly(server: RedisServer, bus: RedisBus, call: Call) -> None:
    with replica(server, "yes"):
        with pytest.raises(BusUnavailable, match="READONLY"):
            call(bus)
        assert bus.config() == b"{}"


@pytest.mark.parametrize("call", READS.values(), ids=READS)
def test_masterdown(server: RedisServer, bus: RedisBus, call: Call) -> None:
    with replica(server, "no"), pytest.raises(BusUnavailable, match="MASTERDOWN"):
        call(bus)


def test_after_a_failover_the_name_leads_to_the_new_master(tmp_path: Path) -> None:
    for folder in ("old", "new"):
        (tmp_path / folder).mkdir(mode=0o700)
    with RedisServer(tmp_path / "old") as old, RedisServer(tmp_path / "new") as new:
        (name := tmp_path / "name").symlink_to(old.socket)
        bus = RedisBus(f"unix://{name}", "run")
        bus.set_config(b"old")
        with replica(old, "yes"):
            name.unlink()
            name.symlink_to(new.socket)
            with pytest.raises(BusUnavailable, match="READONLY"):
                bus.set_config(b"new")
            bus.set_config(b"new")
        assert RedisBus(new.url(), "run").config() == b"new"


@pytest.mark.parametrize("call", WRITES.values(), ids=WRITES)
def test_too_few_replicas(server: RedisServer, bus: RedisBus, call: Call) -> None:
    client = redis.Redis.from_url(server.url())
    client.config_set("min-replicas-to-write", 1)
    try:
        with pytest.raises(BusFull, match="NOREPLICAS"):
            call(bus)
    finally:
        client.config_set("min-replicas-to-write", 0)


@pytest.mark.parametrize(("code", "means"), ANSWERS.items(), ids=ANSWERS)
def test_each_answer_means_what_the_docs_say(code: str, means: type[Exception]) -> None:
    assert type(refusal(ResponseError(f"{code} x"), "redis://x")) is means


@pytest.mark.parametrize(("key", "call"), OF_ANOTHER_TYPE.items(), ids=OF_ANOTHER_TYPE)
def test_a_key_of_another_type_is_named_in_one_line(bus: RedisBus, key: str, call: Call) -> None:
    name = bus.key(*key.strip().split(":"))
    bus.redis.delete(name)
    bus.redis.rpush(name, "a list")
    with pytest.raises(ConfigError, match="WRONGTYPE") as error:
        call(bus)
    assert name in str(error.value)
    assert "delete it" in str(error.value)
    assert "\n" not in str(error.value)


def test_an_answer_shows_no_value(bus: RedisBus) -> None:
    bus.redis.delete(bus.key("acks"))
    bus.redis.rpush(bus.key("acks"), "a list")
    with pytest.raises(ConfigError) as error:
        bus.commit(ReplayOwner("replay", 1), ACK, b"\x00secret\n")
    assert "secret" not in str(error.value)


@pytest.mark.parametrize("value", ["many", "", 2**63 - 1, 2**62, 10**6, -7, "1.5"])
def test_an_epoch_that_none_can_be_is_mended(bus: RedisBus, value: str | int) -> None:
    """By who takes the next; those that look meanwhile, or commit, are not kept from it."""
    bus.redis.set(bus.key("epoch", "actor-0"), value)
    bus.current_epoch("actor-0")
    bus.check_room("actor-0")
    assert [bus.take_epoch("actor-0", floor=9) for _ in range(2)] == [10, 11]
    bus.redis.set(bus.key("epoch", "replay"), "many")
    bus.commit(ReplayOwner("replay", 1), ACK)
    assert bus.current_epoch("replay") == 1


def test_a_cluster_is_waited_for_while_it_is_down(short: Path) -> None:
    words = [server_binary(), "--port", "0", "--unixsocket", f"{short}/r", "--cluster-enabled", "yes", "--dir", short]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as node:
        try:
            bus = connect(f"unix://{short}/r", "run", Deadline(10.0, StopSignal()))
            with pytest.raises(BusUnavailable, match="CLUSTERDOWN"):
                bus.set_config(b"{}")
        finally:
            node.kill()
