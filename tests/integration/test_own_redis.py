"""A run in a Redis of the user's own, which stands still, comes back empty, is busy, or has a key of another type."""

import time
from contextlib import closing
from pathlib import Path

import psutil
import pytest
import redis

from rmc.deploy.redis.server import RedisServer
from tests.integration.running import Training

ENV_TIMEOUT = 2.0
OPTIONS = ("--total-steps", "10000000", "--replay-ratio", "8", "--env-timeout", str(ENV_TIMEOUT))


@pytest.mark.long
def test_neither_ends_the_run_or_a_role(short: Path, tmp_path: Path) -> None:
    with (
        RedisServer(short) as server,
        Training(tmp_path / "run", *OPTIONS, "--redis-url", server.url()) as training,
    ):
        training.wait_for_updates()
        _stand_still(server, 4 * ENV_TIMEOUT)
        training.wait_for_updates(100)
        assert training.newest("launcher", "restarts", None) == 0
        server.close()
        server.start()
        actor = training.role("actor")
        assert actor is not None
        actor.kill()
        training.wait_for(lambda: training.newest("launcher", "restarts") > 0)
        steps = training.newest("replay", "env_steps")
        training.wait_for(lambda: training.newest("replay", "env_steps") > steps + 100)
        training.wait_for_updates(100)
        assert training.newest("launcher", "restarts") == 1, training.logs()
        assert training.interrupt() < 20


@pytest.mark.long
def test_answers_that_pass_are_waited_out_and_one_that_does_not_names_its_key(short: Path, tmp_path: Path) -> None:
    with (
        RedisServer(short) as server,
        Training(tmp_path / "run", *OPTIONS, "--redis-url", server.url()) as training,
        closing(redis.Redis.from_url(server.url())) as client,
    ):
        training.wait_for_updates()
        _be_busy(client, 4.0)
        training.wait_for_updates(100)
        client.replicaof("127.0.0.1", "1")
        time.sleep(4.0)
        client.replicaof("NO", "ONE")
        training.wait_for_updates(100)
        assert training.newest("launcher", "restarts", None) == 0, training.logs()
        (acks,) = client.keys("rmc:*:acks")
        client.pipeline().delete(acks).rpush(acks, "a list").execute()
        training.finish(30)
        line = training.text().splitlines()[-1]
        assert "WRONGTYPE" in line, training.text()
        assert acks.decode() in line
        assert "Traceback" not in training.text()


def _be_busy(client: redis.Redis, seconds: float) -> None:
    """As a script of somebody else's makes it."""
    client.config_set("lua-time-limit", 10)
    client.eval(f"local t = redis.call('TIME')[1] + {seconds} while redis.call('TIME')[1] + 0 < t do end", 0)


def _stand_still(server: RedisServer, seconds: float) -> None:
    assert server.process is not None
    process = psutil.Process(server.process.pid)
    process.suspend()
    time.sleep(seconds)
    process.resume()
