"""A run in a Redis of the user's own, which stands still, or comes back empty when an actor has died, too."""

import tempfile
import time
from pathlib import Path

import psutil

from rmc.deploy.redis.server import RedisServer
from tests.integration.running import Training

ENV_TIMEOUT = 2.0
OPTIONS = ("--total-steps", "10000000", "--replay-ratio", "8", "--env-timeout", str(ENV_TIMEOUT))


def test_neither_ends_the_run_or_a_role(tmp_path: Path) -> None:
    with (
        tempfile.TemporaryDirectory() as short,
        RedisServer(Path(short)) as server,
        Training(tmp_path / "run", *OPTIONS, "--redis-url", server.url()) as training,
    ):
        training.wait_for_updates()
        _stand_still(server, 4 * ENV_TIMEOUT)
        training.wait_for_updates(100)
        assert training.newest("launcher", "restarts") == 0
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


def _stand_still(server: RedisServer, seconds: float) -> None:
    assert server.process is not None
    process = psutil.Process(server.process.pid)
    process.suspend()
    time.sleep(seconds)
    process.resume()
