"""What a run in a Redis of the user's own leaves or shows, searched for that one's password and for its secret.

``test_faults.py`` searches that of an embedded Redis.
"""

import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rmc.deploy.redis.server import server_binary
from rmc.deploy.run.folder import RunFolder
from tests.integration.telling_env import TELLS
from tests.integration.watched import Watched, check_all_was_searched, holding

TELLING, PLAYERS = "tests.integration.telling_env:Telling-v0", ("actor", "evaluator")  # beside the launcher
ENDLESS = ("--total-steps", "100000000", "--checkpoint-steps", "500")
PASSWORD = "hunter2-of-the-users-own-redis"


@contextmanager
def own_redis() -> Iterator[str]:
    """A user's, which asks for a password; its URL."""
    with tempfile.TemporaryDirectory(prefix="rmc-own-") as folder:
        socket = Path(folder) / "own.sock"
        words = f'port 0\nunixsocket {socket}\nsave ""\ndir {folder}\nrequirepass {PASSWORD}\n'
        server = subprocess.Popen([server_binary(), "-"], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
        assert server.stdin is not None
        with server.stdin as settings:
            settings.write(words.encode())
        try:
            while not socket.exists():
                assert server.poll() is None
                time.sleep(0.05)
            yield f"unix://:{PASSWORD}@{socket}"
        finally:
            server.kill()
            server.wait()


def test_the_password_of_the_users_own_redis_is_nowhere(tmp_path: Path) -> None:
    """It stands in a file that the command line names. What was exported is neither passed on nor inherited."""
    log = tmp_path / "told"
    log.mkdir()
    with own_redis() as url:
        (tmp_path / "redis-url").write_text(f"{url}\n")
        options = (*ENDLESS, "--redis-url", f"file:{tmp_path}/redis-url")
        exported = {"RMC_SECRET": PASSWORD, "RMC_REDIS_URL": f"redis://:{PASSWORD}@localhost:1", TELLS: str(log)}
        with Watched(tmp_path / "run", *options, env=TELLING, environment=exported) as training:
            training.go_on(1)
            players = {str(role.pid) for name in PLAYERS if (role := training.role(name)) is not None}
            passed_on = [child.environ() for child in training.launcher.children(recursive=True)]
            training.interrupt()
    inherited = {path.name: path.read_text() for path in log.iterdir()}
    assert len(players) == len(PLAYERS)
    assert inherited.keys() >= {str(training.process.pid), *players}
    assert not any("RMC_SECRET" in words or "RMC_REDIS_URL" in words for words in inherited.values())
    assert len(passed_on) >= len(PLAYERS)
    assert not any(PASSWORD in value for variables in passed_on for value in variables.values())
    left = training.left()
    check_all_was_searched(left, training.folder)
    assert holding(left, {PASSWORD.encode()}) == set()
    assert holding(left, {RunFolder(training.folder).secret()}) == {str(training.folder / "secret")}
