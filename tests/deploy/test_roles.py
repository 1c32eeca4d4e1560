"""How a role finds its run."""

import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from common.errors import ConfigError
from deploy.redis_server import RedisServer
from deploy.roles import connect


def test_a_role_waits_for_a_redis_that_is_coming_back() -> None:
    with tempfile.TemporaryDirectory() as folder:  # pytest's own are too long for a socket's path
        server = RedisServer(Path(folder))
        url = f"unix://{folder}/redis.sock"
        with pytest.raises(ConfigError, match="no Redis answers"):
            connect(url, "run")
        with ThreadPoolExecutor(1) as pool:
            waiting = pool.submit(connect, url, "run", 20.0)
            time.sleep(0.7)
            with server:
                waiting.result().ping()
