"""Both buses keep the same promises."""

import itertools
import os
import uuid
from contextlib import nullcontext

import pytest
import redis

from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.bus.protocol import (
    MAX_EPOCH_GAP,
    METRICS_KEPT,
    Ack,
    Bus,
    Entry,
    EntryId,
    ReplayOwner,
    Version,
)
from rmc.common.bus.redis_bus import DEAD_LETTERS_KEPT, RECORDS_READ, RedisBus
from rmc.common.bus.weight_store import PIECE_BYTES, UNPUBLISHED_SECONDS
from rmc.common.errors import BusFull, BusUnavailable, ConfigError, FencedError
from rmc.common.process.role import StopSignal
from rmc.deploy.local.role_context import until_taken
from rmc.deploy.redis.server import RedisServer


@pytest.fixture(params=["memory", "redis"])
def bus(request, redis_url) -> Bus:
    return MemoryBus() if request.param == "memory" else RedisBus(redis_url, f"test-{uuid.uuid4().hex}")


def test_config_and_stop(redis_url):
    bus = RedisBus(redis_url, f"test-{uuid.uuid4().hex}")
    assert bus.config() is None
    assert bus.stop_requested() is None
    bus.set_config(b"{}")
    bus.request_stop("done")
    assert (bus.config(), bus.stop_requested()) == (b"{}", "done")
    bus.clear_stop()
    assert bus.stop_requested() is None


def test_epochs_rise_past_the_floor(bus):
    assert [bus.take_epoch("actor-0"), bus.take_epoch("actor-0"), bus.take_epoch("replay")] == [1, 2, 1]
    assert bus.take_epoch("actor-0", floor=9) == 10
    assert bus.take_epoch("actor-0", floor=3) == 11
    assert bus.current_epoch("actor-0") == 11


def test_entries_are_read_in_order_and_trimmed_by_commit(bus):
    owner = ReplayOwner("replay", bus.take_epoch("replay"))
    for seq in range(5):
        bus.append(3, EntryId(1, seq), b"%d" % seq)
    assert bus.actors() == [3]
    assert bus.read({3: EntryId(0, 0)}, 2) == [Entry(3, EntryId(1, 0), b"0"), Entry(3, EntryId(1, 1), b"1")]
    bus.commit(owner, {3: Ack(EntryId(1, 2), 77, True)})
    assert [entry.id.seq for entry in bus.read({3: EntryId(0, 0)}, 10)] == [3, 4]
    assert bus.ack(3) == Ack(EntryId(1, 2), 77, True)
    assert bus.ack(4) is None


def test_a_repeated_append_is_stored_once(bus):
    for _ in range(3):
        bus.append(0, EntryId(1, 0), b"hello")
        bus.append(0, EntryId(1, 1), b"x")
    assert len(bus.read({0: EntryId(0, 0)}, 10)) == 2


def test_a_redis_that_lost_its_data_hears_of_the_learners_epoch_again(redis_url):
    bus = RedisBus(redis_url, f"test-{uuid.uuid4().hex}")
    for _ in range(3):
        epoch = bus.take_epoch("learner")
    bus.redis.delete(bus.key("epoch", "learner"))
    bus.publish_weights(Version(epoch, 7), b"weights")
    assert bus.take_epoch("learner") == epoch + 1


def test_a_redis_that_lost_its_data_hears_of_the_replay_servers_epoch_again(bus):
    """Else the next server would begin below it, and both would write."""
    bus.commit(ReplayOwner("replay", 7), {0: Ack(EntryId(1, 0), 0)})
    assert bus.current_epoch("replay") == 7
    with pytest.raises(FencedError):
        bus.commit(ReplayOwner("replay", 6), {0: Ack(EntryId(1, 1), 0)})


def test_an_older_epoch_is_fenced(bus):
    bus.append(0, EntryId(1, 0), b"")
    bus.append(0, EntryId(2, 0), b"")
    with pytest.raises(FencedError):
        bus.append(0, EntryId(1, 1), b"late")


@pytest.mark.parametrize("forged", [(2**64 - 1, 2**64 - 1), (2**64 - 1, 0), (2**31 - 1, 2**53), (2**20, 0), (3, 0)])
@pytest.mark.parametrize("counted", [2, 2**40])
def test_an_entry_of_an_epoch_that_nobody_can_have_taken_fences_nobody(redis_url, forged, counted):
    bus = RedisBus(redis_url, f"test-{uuid.uuid4().hex}")
    owner = ReplayOwner("replay", bus.take_epoch("replay"))
    epoch = [bus.take_epoch("actor-0") for _ in range(2)][-1]
    for seq in range(2):
        bus.append(0, EntryId(epoch, seq), b"%d" % seq)
    bus.redis.xadd(bus.key("windows", 0), {"p": b"x"}, id=f"{forged[0]}-{forged[1]}")
    bus.redis.set(bus.key("epoch", "actor-0"), counted)
    is_lawful = forged[0] == 3 and counted > 2  # a life that was begun
    for seq in (0, 2):
        with pytest.raises(FencedError if is_lawful else BusUnavailable, match="epoch"):
            bus.append(0, EntryId(epoch, seq), b"%d" % seq)
    bus.drop_stream(owner, 0)
    for seq in range(3):
        bus.append(0, EntryId(epoch, seq), b"%d" % seq)
    assert [entry.id for entry in bus.read({0: EntryId(0, 0)}, 10)] == [EntryId(epoch, seq) for seq in range(3)]


def test_a_hello_makes_its_epoch_known_again(bus):
    """Where Redis lost the counter alone, or all; an older life is fenced then, too."""
    bus.append(0, EntryId(5, 0), b"hello")
    assert bus.current_epoch("actor-0") == 5
    with pytest.raises(FencedError):
        bus.append(0, EntryId(4, 0), b"hello")
    assert bus.current_epoch("actor-0") == 5
    assert bus.take_epoch("actor-0") == 6


def test_epochs_far_beyond_the_floor_are_not_believed(bus):
    bus.append(0, EntryId(MAX_EPOCH_GAP + 10, 0), b"hello")
    assert bus.take_epoch("actor-0", floor=3) == 4
    assert bus.take_epoch("actor-0", floor=MAX_EPOCH_GAP + 7) == MAX_EPOCH_GAP + 8


def test_a_replaced_replay_server_cannot_trim(bus):
    old = ReplayOwner("replay", bus.take_epoch("replay"))
    bus.append(0, EntryId(1, 0), b"")
    bus.take_epoch("replay")
    with pytest.raises(FencedError):
        bus.commit(old, {0: Ack(EntryId(1, 0), 0)})
    assert len(bus.read({0: EntryId(0, 0)}, 10)) == 1
    bus.commit(
        ReplayOwner("replay-1", bus.take_epoch("replay-1")), {0: Ack(EntryId(1, 0), 0)}
    )  # another shard's epochs
    assert bus.read({0: EntryId(0, 0)}, 10) == []


def test_a_dropped_stream_is_sent_again_from_its_hello(bus):
    owner = ReplayOwner("replay", bus.take_epoch("replay"))
    for seq in (0, 1, 3):
        bus.append(0, EntryId(1, seq), b"%d" % seq)
    bus.drop_stream(owner, 0)
    with pytest.raises(BusUnavailable, match="gone"):
        bus.append(0, EntryId(1, 4), b"4")
    for seq in (0, 2, 3):
        bus.append(0, EntryId(1, seq), b"%d" % seq)
    assert [entry.id.seq for entry in bus.read({0: EntryId(1, 1)}, 10)] == [2, 3]
    bus.take_epoch("replay")
    with pytest.raises(FencedError):
        bus.drop_stream(owner, 0)


@pytest.mark.parametrize("seq", [0, 1])
def test_a_stream_that_is_dropped_while_it_refuses_is_gone(redis_url, monkeypatch, seq):
    bus = RedisBus(redis_url, f"test-{uuid.uuid4().hex}")
    owner, ask = ReplayOwner("replay", bus.take_epoch("replay")), bus.redis.xinfo_stream
    for number in range(2):
        bus.append(0, EntryId(1, number), b"x")

    def drop_and_ask(stream):
        bus.drop_stream(owner, 0)
        return ask(stream)

    monkeypatch.setattr(bus.redis, "xinfo_stream", drop_and_ask)
    with pytest.raises(BusUnavailable, match="gone"):
        bus.append(0, EntryId(1, seq), b"x")


def test_weights_of_many_pieces(bus):
    epoch = bus.take_epoch("learner")
    blob = os.urandom(700_000)
    assert bus.weights() is None
    assert bus.latest_version() is None
    bus.publish_weights(Version(epoch, 5), blob)
    assert bus.weights() == (Version(epoch, 5), blob)
    assert bus.latest_version(evaluate=True) is None
    bus.publish_weights(Version(epoch, 6), b"six", evaluate=True)
    assert (bus.weights(), bus.weights(evaluate=True)) == ((Version(epoch, 5), blob), (Version(epoch, 6), b"six"))
    bus.publish_weights(Version(epoch, 6), b"half a dozen")
    assert bus.weights() == (Version(epoch, 6), b"half a dozen")
    assert bus.weights(evaluate=True) == (Version(epoch, 6), b"six")


def test_a_replaced_learner_cannot_publish(bus):
    old = bus.take_epoch("learner")
    new = bus.take_epoch("learner")
    bus.publish_weights(Version(new, 1), b"new")
    with pytest.raises(FencedError):
        bus.publish_weights(Version(old, 99), b"old")
    assert bus.latest_version() == Version(new, 1)


def piece_lives(bus: RedisBus, kind: str = "weights") -> dict[Version, list[int]]:
    """Seconds until each piece there expires, by version; -1 where it does not."""
    received: dict[Version, list[int]] = {}
    for key in bus.redis.scan_iter(match=bus.key(kind, "*")):
        epoch, update, _ = map(int, key.decode().rsplit(":", 3)[1:])
        received.setdefault(Version(epoch, update), []).append(bus.redis.ttl(key))
    return received


def test_what_was_published_stays_and_what_was_fenced_expires(redis_url):
    bus = RedisBus(redis_url, f"test-{uuid.uuid4().hex}")
    old, new, blob = bus.take_epoch("learner"), bus.take_epoch("learner"), os.urandom(PIECE_BYTES + 1)
    bus.publish_weights(Version(new, 1), blob)
    bus.publish_weights(Version(new, 2), blob)
    bus.publish_weights(Version(new, 2), blob, evaluate=True)  # another policy by the same version
    bus.publish_weights(Version(new, 3), blob)
    bus.publish_weights(Version(new, 3), blob)  # the version that is there already
    with pytest.raises(FencedError):
        bus.publish_weights(Version(old, 9), blob)
    lives = piece_lives(bus)
    assert lives[Version(new, 3)] == [-1, -1]
    assert all(0 < life <= 5 for update in (1, 2) for life in lives[Version(new, update)])
    assert piece_lives(bus, "evaluate") == {Version(new, 2): [-1, -1]}
    assert all(0 < life <= UNPUBLISHED_SECONDS for life in lives[Version(old, 9)])
    assert len(lives[Version(old, 9)]) == 2
    bus.expire(None)  # the run goes on: what nobody published still goes
    lives = piece_lives(bus)
    assert lives[Version(new, 3)] == piece_lives(bus, "evaluate")[Version(new, 2)] == [-1, -1]
    assert all(life > 0 for life in lives[Version(old, 9)])


def test_weights_that_went_before_they_were_the_newest_are_not_named(redis_url, monkeypatch):
    bus = RedisBus(redis_url, f"test-{uuid.uuid4().hex}")
    bus.publish_weights(Version(1, 1), b"one")
    transaction = bus.redis.transaction

    def empty_and_go_on(*args, **options):
        bus.redis.delete(bus.key("weights", 1, 2, 0))
        return transaction(*args, **options)

    monkeypatch.setattr(bus.redis, "transaction", empty_and_go_on)
    stop = StopSignal()
    repeated = bus.repeated(lambda call: until_taken(call, "learner", stop))  # as a learner that starts
    for context in (nullcontext(), repeated):
        with context, pytest.raises(BusUnavailable, match="gone before"):
            bus.publish_weights(Version(1, 2), b"two")
    assert bus.weights() == (Version(1, 1), b"one")


def test_metrics_by_role(bus):
    bus.emit("learner", {"updates": 1})
    bus.emit("learner", {"updates": 2})
    bus.emit("actor-0", {"role": 7, "updates": 3})
    records, cursors = bus.records({"learner": "0", "evaluator": "0"})
    assert records == [{"role": "learner", "updates": 1}, {"role": "learner", "updates": 2}]
    assert bus.records(cursors)[0] == []
    assert bus.records_end(cursors) == cursors
    bus.emit("evaluator", {"eval_update": 4})
    assert bus.records(cursors)[0] == [{"role": "evaluator", "eval_update": 4}]
    assert bus.records({})[0] == []
    assert bus.records({"actor-0": "0"})[0] == [{"role": "actor-0", "updates": 3}]  # it cannot say that it is another


def test_what_is_no_record_is_left_out_and_a_flood_is_trimmed(redis_url):
    bus = RedisBus(redis_url, f"test-{uuid.uuid4().hex}")
    client, key = bus.redis, bus.key("metrics", "actor-0")
    client.xadd(key, {"x": b"no record"})
    for packed in (b"", b"\xff", b"\x81\xa1a\xa1b"):
        client.xadd(key, {"r": packed})
    bus.emit("actor-0", {"updates": 1})
    assert bus.records({"actor-0": "0"})[0] == [{"role": "actor-0", "updates": 1}]
    assert bus.refused == {"msgpack": 2, "structure": 2}
    with client.pipeline(transaction=False) as pipe:
        for _ in range(2 * RECORDS_READ):
            pipe.xadd(key, {"r": b"\x80"})
        pipe.execute()
    bus.records({"actor-0": "0"})
    assert client.xlen(key) <= 1.1 * METRICS_KEPT
    for seq in range(3 * DEAD_LETTERS_KEPT):
        bus.dead_letter(Entry(0, EntryId(1, seq), b""), "crc")
    assert client.xlen(bus.key("dead")) <= 1.1 * DEAD_LETTERS_KEPT


@pytest.mark.parametrize("value", [b"a b c d", b"1 2 3", b"1 2 3 4 5", b"1 2 3 \xff", b"9" * 40, b"1 2 3 4.0", b"\x00"])
def test_what_is_no_control_message_is_none_and_counted(redis_url, value):
    bus = RedisBus(redis_url, f"test-{uuid.uuid4().hex}")
    bus.redis.set(bus.key("weights"), value)
    bus.redis.hset(bus.key("acks"), "0", value)
    assert (bus.latest_version(), bus.weights(), bus.ack(0)) == (None, None, None)
    assert bus.refused["control"] == 3


def test_weights_of_too_many_pieces_are_not_asked_for(redis_url):
    bus = RedisBus(redis_url, f"test-{uuid.uuid4().hex}")
    bus.redis.set(bus.key("weights"), b"1 2 1000000000 4")
    assert bus.weights() is None


def test_only_numbers_are_actors(redis_url):
    bus = RedisBus(redis_url, f"test-{uuid.uuid4().hex}")
    bus.redis.sadd(bus.key("actors"), "3", "-1", "10000", "no", "", "²", "1e3")
    assert bus.actors() == [3]


def test_the_memory_bus_forgets_old_records():
    bus, cursors, seen = MemoryBus(), {"actor-0": "0"}, []
    for i in range(5 * METRICS_KEPT // 2):
        bus.emit("actor-0", {"i": i})
        if i % (METRICS_KEPT // 3) == 0:
            records, cursors = bus.records(cursors)
            seen += [record["i"] for record in records]
    seen += [record["i"] for record in bus.records(cursors)[0]]
    assert seen == list(range(5 * METRICS_KEPT // 2))
    assert METRICS_KEPT <= len(bus.records({"actor-0": "0"})[0]) < 2 * METRICS_KEPT


def test_a_full_redis_is_emptied_by_commits(short):
    with RedisServer(short) as server:
        bus = RedisBus(server.url(), "full")
        bus.redis.config_set("maxmemory", 8 << 20)
        owner, seq = ReplayOwner("replay", bus.take_epoch("replay")), fill(bus)
        assert seq > 10
        bus.commit(owner, {0: Ack(EntryId(1, seq - 1), 5)})
        assert bus.ack(0) == Ack(EntryId(1, seq - 1), 5)
        bus.append(0, EntryId(1, seq), b"and on it goes")
        assert len(bus.read({0: EntryId(0, 0)}, 1000)) == 1
        fill(bus, seq + 1)
        bus.take_epoch("replay")
        with pytest.raises(FencedError):
            bus.commit(owner, {0: Ack(EntryId(1, seq), 5)})  # replaced, and nothing is trimmed
        assert len(bus.read({0: EntryId(0, 0)}, 1000)) > 10
        with pytest.raises(BusUnavailable, match="out of range"):
            RedisBus(f"{server.url()}?db=99", "full").ping()


def test_a_full_redis_trims_in_no_transaction_that_says_acks(short):
    """Or trimming would need no script, and no role the right to run one."""
    with RedisServer(short) as server:
        bus = RedisBus(server.url(), "full")
        for seq in range(20):
            bus.append(0, EntryId(1, seq), b"x" * 200_000)
        bus.redis.config_set("maxmemory", 2 << 20)
        pipe = bus.redis.pipeline()
        pipe.xtrim(bus.key("windows", 0), maxlen=1, approximate=False)
        pipe.hset(bus.key("acks"), "0", b"")  # trimming alone is refused by Redis 7.0, not by Valkey 7.2
        with pytest.raises(redis.exceptions.OutOfMemoryError):
            pipe.execute()
        assert bus.redis.xlen(bus.key("windows", 0)) == 20
        bus.commit(ReplayOwner("replay", 1), {0: Ack(EntryId(1, 18), 5)})
        assert bus.redis.xlen(bus.key("windows", 0)) == 1
        bus.redis.config_set("maxmemory", 1)
        bus.drop_stream(ReplayOwner("replay", 1), 0)
        assert not bus.redis.exists(bus.key("windows", 0))


def fill(bus: Bus, start: int = 0) -> int:
    """Append until Redis is full; the number of the entry that it refused."""
    for seq in itertools.count(start):
        try:
            bus.append(0, EntryId(1, seq), b"x" * 200_000)
        except BusFull:
            return seq
    raise AssertionError("never full")


def test_replay_address(bus):
    assert bus.replay_address("replay") is None
    bus.announce_replay(ReplayOwner("replay", 2), "unix:/tmp/a b")
    assert bus.replay_address("replay") == "unix:/tmp/a b"
    assert bus.replay_address("replay-0") is None


def test_no_redis_there(tmp_path):
    with pytest.raises(BusUnavailable):
        RedisBus(f"unix://{tmp_path}/none.sock", "x").ping()


def test_a_url_that_is_none():
    with pytest.raises(ConfigError, match="--redis-url"):
        RedisBus("http://example", "x")
