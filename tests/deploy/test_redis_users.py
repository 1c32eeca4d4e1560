"""Every role may do in Redis what its work takes, and nothing else; against a real server."""

import errno
import os
import re
import signal
import socket
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import redis

from rmc.common import whole_file
from rmc.common.bus.protocol import Ack, EntryId, ReplayOwner, Version
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.errors import BusUnavailable, ConfigError
from rmc.common.shard import Shard
from rmc.deploy.redis.connect import connect
from rmc.deploy.redis.server import Port, RedisServer
from rmc.deploy.redis.users import LAUNCHER, RedisUsers, actor_patterns

SECRET = b"of the run"
USERS = RedisUsers("odd name*[1]é", SECRET, ("learner", "evaluator", "replay", "actor-0", "actor-1"))
ROLES = [*USERS.roles, LAUNCHER]
EVERYWHERE = """
    FUNCTION LIST|SCRIPT LOAD x|CONFIG GET *|KEYS *|FLUSHALL|FLUSHDB|SHUTDOWN|CONFIG SET dir /|ACL LIST
    ACL SETUSER default on|CLIENT LIST
    MONITOR|SAVE|REPLICAOF 127.0.0.1 1|MODULE LIST|SUBSCRIBE x|MIGRATE 127.0.0.1 1 x 0 1|SORT x
    GET other|SET other 1|EVAL redis.call('SET',KEYS[1],1) 1 R:weights
"""
FORBIDDEN = {  # R for the prefix
    "actor-0": """
        XADD R:windows:1 * p x|XRANGE R:windows:0 - +|DEL R:windows:0|XTRIM R:windows:0 MAXLEN 0
        XREAD STREAMS R:metrics:actor-0 0|SET R:config x|SET R:weights x|SET R:weights:1:1:0 x|SET R:stop x
        GET R:evaluate|GET R:evaluate:1:1:0|HSET R:acks 0 x|SCAN 0
        HSET R:replay replay x|INCR R:epoch:actor-1|INCR R:epoch:learner
        XADD R:metrics:learner * r x|XADD R:dead * reason x
    """,
    "actor-1": "XADD R:windows:0 * p x|XADD R:windows:10 * p x|INCR R:epoch:actor-0|XINFO STREAM R:windows:0",
    "evaluator": """
        XADD R:windows:0 * p x|SET R:evaluate x|HGET R:acks 0|SCAN 0|INCR R:epoch:learner
        SET R:weights x|SET R:weights:1:1:0 x|SET R:evaluate:1:1:0 x|SET R:config x|SET R:stop x
    """,
    "learner": """
        XADD R:windows:0 * p x|SET R:config x|INCR R:epoch:replay|HSET R:replay a b|XREAD STREAMS R:windows:0 0
        SET R:stop x|SCAN 0|DEL R:weights|HSET R:acks 0 x|HSET R:progress replay x|HSETNX R:progress replay x
        SADD R:actors 7|XADD R:dead * reason x|EXPIRE R:weights 1|PERSIST R:config
    """,
    "replay": """
        XADD R:windows:0 * p x|SET R:weights x|SET R:config x|SET R:epoch:learner 9|SADD R:actors 7|SCAN 0
        XADD R:metrics:learner * r x|EXPIRE R:weights:1:1:0 1
    """,
    LAUNCHER: "",
}


@pytest.fixture(scope="module")
def server() -> Iterator[RedisServer]:
    with tempfile.TemporaryDirectory(prefix="rmc-users-") as folder, RedisServer(Path(folder), users=USERS) as server:
        yield server


def bus_of(server: RedisServer, user: str) -> RedisBus:
    return RedisBus(server.url(user), USERS.run)


def test_every_role_can_do_its_work(server: RedisServer) -> None:
    """The bus's whole interface, each call by who makes it."""
    launcher, learner, evaluator, replay, actor = (
        bus_of(server, user) for user in (LAUNCHER, "learner", "evaluator", "replay", "actor-0")
    )
    launcher.expire(None)
    launcher.set_config(b"{}")
    launcher.clear_stop()
    launcher.set_progress("replay", b"counted")
    for role, bus in (("learner", learner), ("evaluator", evaluator), ("replay", replay), ("actor-0", actor)):
        bus.ping()
        assert bus.config() == b"{}"
        assert bus.stop_requested() is None
        assert bus.take_epoch(role, floor=4) == 5
        assert bus.current_epoch(role) == 5
        bus.emit(role, {"updates": 1})
    actor.append(0, EntryId(5, 0), b"hello")
    for _ in range(2):  # the second is refused by its id, and looked up
        actor.append(0, EntryId(5, 1), b"windows")
    assert (launcher.memory_bytes() > 0, actor.memory_bytes()) == (True, 0)  # it may not ask
    owner = ReplayOwner("replay", 5)
    assert replay.progress("replay") == b"counted"
    assert replay.actors() == [0]
    assert len(replay.read({0: EntryId(0, 0)}, 10)) == 2
    (_, entry) = replay.read({0: EntryId(4, 0)}, 10)
    replay.dead_letter(entry, "a test")
    replay.announce_replay(owner, "unix:/nowhere")
    assert replay.current_epoch("learner") == 5
    replay.commit(owner, {0: Ack(EntryId(5, 1), 100)}, b"more")
    replay._trim(owner, {0: Ack(EntryId(5, 1), 100)})
    assert learner.replay_address("replay") is not None
    for update in (1, 2, 3):
        for evaluate in (False, True):
            learner.publish_weights(Version(5, update), b"w" * 600_000, evaluate)
    assert replay.latest_version() == Version(5, 3)
    assert actor.ack(0) == Ack(EntryId(5, 1), 100)
    for bus, evaluate in ((actor, False), (evaluator, True)):
        assert bus.latest_version(evaluate) == Version(5, 3)
        assert bus.weights(evaluate) == (Version(5, 3), b"w" * 600_000)
    replay.drop_stream(owner, 0)
    assert launcher.progress("replay") == b"more"
    records, _ = launcher.records(dict.fromkeys(USERS.roles, "0"))
    assert [record["role"] for record in records] == ["learner", "evaluator", "replay", "actor-0"]
    launcher.request_stop("done")
    launcher.expire(60)


@pytest.mark.parametrize("more", [2**20, 2**50, 2**62])
def test_an_actors_login_retires_no_life(server: RedisServer, more: int) -> None:
    """Neither by its stream nor by its counter: its next life goes on, and the present one is not fenced."""
    actor, replay = bus_of(server, "actor-1"), bus_of(server, "replay")
    owner = ReplayOwner("replay", replay.take_epoch("replay"))
    replay.drop_stream(owner, 1)
    epoch = actor.take_epoch("actor-1")
    actor.append(1, EntryId(epoch, 0), b"hello")
    with redis.Redis.from_url(server.url("actor-1")) as client:
        prefix = f"rmc:{USERS.run}"
        client.incrby(f"{prefix}:epoch:actor-1", more)
        client.xadd(f"{prefix}:windows:1", {"p": b"x"}, id=f"{2**64 - 1}-{2**64 - 1}")
    with pytest.raises(BusUnavailable, match="nobody has taken"):
        actor.append(1, EntryId(epoch, 1), b"windows")
    replay.drop_stream(owner, 1)
    for seq in range(2):
        actor.append(1, EntryId(epoch, seq), b"windows")
    assert actor.take_epoch("actor-1", floor=epoch) == epoch + 1


SHARDED = RedisUsers(USERS.run, SECRET, ("replay-0", "replay-1", "actor-0", "actor-1"))
FORBIDDEN_TO_SHARDS = """
    DEL R:windows:OTHER|XTRIM R:windows:OTHER MAXLEN 0|XREAD STREAMS R:windows:OTHER 0|XADD R:windows:OTHER * p x
    XREAD STREAMS R:windows:OWN R:windows:OTHER 0 0|DEL R:windows:1OTHER|DEL R:windows:204OTHER|DEL R:windows:1000OTHER
    DEL R:windows:|DEL R:windows:*|DEL R:windows:x
    EVAL redis.call('XTRIM',KEYS[1],'MAXLEN',0) 1 R:windows:OTHER|EVAL redis.call('GET',KEYS[1]) 1 R:epoch:replay-OTHER
    INCR R:epoch:replay-OTHER|SET R:epoch:replay-OTHER 9|SET R:epoch:learner 9|XADD R:metrics:replay-OTHER * r x
    SET R:weights x|SET R:config x|SADD R:actors 7|SCAN 0
"""


def test_shards_have_their_own_actors_streams(short: Path) -> None:
    with RedisServer(short, users=SHARDED) as server:
        for own, other in ((0, 1), (1, 0)):
            bus = RedisBus(server.url(f"replay-{own}"), USERS.run)
            owner = ReplayOwner(f"replay-{own}", bus.take_epoch(f"replay-{own}"))
            acks = {actor + own: Ack(EntryId(1, 1), 0) for actor in (0, 8, 10, 98, 100, 4094)}
            bus.commit(owner, acks, b"counted")
            bus._trim(owner, acks)
            bus.drop_stream(owner, own)
            forbidden = FORBIDDEN_TO_SHARDS.replace("OTHER", str(other)).replace("OWN", str(own))
            with redis.Redis.from_url(server.url(owner.role)) as client:
                for words in split_commands(forbidden):
                    assert "permission" in answer(client, words), words


@pytest.mark.parametrize("count", [2, 3, 4, 5, 7, 8, 16, 1009])
def test_an_actors_stream_is_one_shards(count: int) -> None:
    patterns = [re.compile("|".join(actor_patterns(Shard(index, count)))) for index in (0, 1, count // 2, count - 1)]
    for index, pattern in zip((0, 1, count // 2, count - 1), patterns, strict=True):
        assert [actor for actor in range(4096) if pattern.fullmatch(str(actor))] == list(range(index, 4096, count))
    assert len(actor_patterns(Shard(0, count))) <= 400


def commands(user: str) -> list[list[str]]:
    """The words of every command that a user may not use."""
    return split_commands("\n".join([EVERYWHERE, FORBIDDEN[user]]))


def split_commands(text: str) -> list[list[str]]:
    lines, prefix = text.replace("\n", "|").split("|"), f"rmc:{USERS.run}:"
    return [[word.replace("R:", prefix, 1) for word in line.split()] for line in lines if line.strip()]


def answer(client: redis.Redis, words: list[str]) -> str:
    try:
        return f"it ran, and gave {client.execute_command(*words)!r}"
    except redis.exceptions.ResponseError as error:
        return str(error)


@pytest.mark.parametrize("user", ROLES)
def test_every_other_command_is_refused(server: RedisServer, user: str) -> None:
    with redis.Redis.from_url(server.url(user)) as client:
        for words in commands(user):
            assert "permission" in answer(client, words), words


@pytest.mark.parametrize("login", ["", "default:guess@", "actor-0:guess@", f"actor-0:{USERS.password('actor-1')}@"])
def test_a_stranger_is_told_so_in_one_line_that_holds_no_password(server: RedisServer, login: str) -> None:
    with pytest.raises(ConfigError, match=r"--redis-url=.*no Redis answers there") as error:
        connect(f"unix://{login}{server.socket}", USERS.run)
    assert "\n" not in str(error.value)
    assert "guess" not in str(error.value)
    assert USERS.password("actor-1") not in str(error.value)


def test_users_that_come_later_get_in(short: Path) -> None:
    with RedisServer(short, users=USERS) as server:
        held = bus_of(server, "actor-1")
        held.ping()
        more = RedisUsers(USERS.run, SECRET, (*USERS.roles, "actor-2"))
        with pytest.raises(BusUnavailable):
            RedisBus(f"unix://{more.login('actor-2')}{server.socket}", USERS.run).ping()
        server.admit(more)
        bus_of(server, "actor-2").append(2, EntryId(1, 0), b"hello")
        held.append(1, EntryId(1, 0), b"hello")


def test_users_that_come_while_the_server_stands_still_get_in_later(short: Path) -> None:
    with RedisServer(short, users=USERS) as server:
        assert server.process is not None
        server.process.send_signal(signal.SIGSTOP)
        more = RedisUsers(USERS.run, SECRET, (*USERS.roles, "actor-2"))
        server.admit(more)
        server.tend()
        server.process.send_signal(signal.SIGCONT)
        server.tend()
        late = bus_of(server, "actor-2")
        late.ping()
        late.redis.close()


def test_where_there_is_no_room_for_other_users_those_before_stay(short: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, _: bytes) -> None:
        path.write_bytes(b"")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with RedisServer(short, users=USERS) as server:
        with monkeypatch.context() as patch:
            patch.setattr(whole_file, "write_synced", full)
            with pytest.raises(OSError, match="No space"):
                server.admit(RedisUsers(USERS.run, SECRET, (*USERS.roles, "actor-2")))
        server._read_users()
        there = bus_of(server, "actor-1")
        there.ping()
        there.redis.close()


def test_passwords_are_nowhere_to_be_read(short: Path) -> None:
    """Neither on a command line nor in the server's files or a value's repr; files are the owner's alone."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        number = int(probe.getsockname()[1])
    port = Port("127.0.0.1", number)
    with RedisServer(short, port=port, users=USERS) as server:
        RedisBus(server.network_url("actor-0"), USERS.run).ping()
        assert server.process is not None
        visible = Path(f"/proc/{server.process.pid}/cmdline").read_text() + repr(USERS)
        visible += "".join(file.read_text() for file in short.iterdir() if not file.is_socket())
        assert stat.S_IMODE((short / "users.acl").stat().st_mode) == 0o600
        assert not [user for user in ROLES if USERS.password(user) in visible]
        assert SECRET.decode() not in visible
