"""What a run in a Redis of the user's own leaves or shows, searched for that one's password and for its secret.

``test_faults.py`` searches that of an embedded Redis.
"""

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rmc.deploy.redis.server import server_binary
from rmc.deploy.run.folder import RunFolder
from tests.command import COMMAND, rmc
from tests.integration.running import Training
from tests.integration.telling_env import TELLS
from tests.integration.watched import Watched, check_all_was_searched, holding

TELLING, PLAYERS = "tests.integration.telling_env:Telling-v0", ("actor", "evaluator")  # beside the launcher
ENDLESS = ("--total-steps", "100000000", "--checkpoint-steps", "500")
PASSWORD = "hunter2-of-the-users-own-redis"


@contextmanager
def own_redis(folder: Path) -> Iterator[str]:
    """A user's, which asks for a password; its URL."""
    socket = folder / "own.sock"
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


def stopped_from_another_terminal(run: Training) -> str:
    """It is watched by ``rmc attach`` until ``rmc stop`` ends it; what both print."""
    with subprocess.Popen([*COMMAND, "attach", str(run.folder)], stdout=subprocess.PIPE, text=True) as watcher:
        assert watcher.stdout is not None
        first = watcher.stdout.readline()
        assert first.startswith("0% | ")
        stop = rmc("stop", str(run.folder), timeout=60)
        assert (stop.returncode, stop.stderr) == (0, "")
        rest = watcher.stdout.read()
        assert all("to go on:\n  rmc resume " in text for text in (stop.stdout, rest))
        assert (run.finish(30), watcher.wait(30)) == (130, 130)
    return first + rest + stop.stdout


def test_the_password_of_the_users_own_redis_is_nowhere(short: Path, tmp_path: Path) -> None:
    """It stands in a file that the command line names. What was exported is neither passed on nor inherited."""
    log = tmp_path / "told"
    log.mkdir()
    with own_redis(short) as url:
        (tmp_path / "redis-url").write_text(f"{url}\n")
        options = (*ENDLESS, "--redis-url", f"file:{tmp_path}/redis-url")
        exported = {"RMC_SECRET": PASSWORD, "RMC_REDIS_URL": f"redis://:{PASSWORD}@localhost:1", TELLS: str(log)}
        with Watched(tmp_path / "run", *options, env=TELLING, environment=exported) as training:
            training.go_on(1)
            players = {str(role.pid) for name in PLAYERS if (role := training.role(name)) is not None}
            passed_on = [child.environ() for child in training.launcher.children(recursive=True)]
            printed = stopped_from_another_terminal(training)
    inherited = {path.name: path.read_text() for path in log.iterdir()}
    assert len(players) == len(PLAYERS)
    assert inherited.keys() >= {str(training.process.pid), *players}
    assert not any("RMC_SECRET" in words or "RMC_REDIS_URL" in words for words in inherited.values())
    assert len(passed_on) >= len(PLAYERS)
    assert not any(PASSWORD in value for variables in passed_on for value in variables.values())
    left = training.left() | {"attach and stop": printed.encode()}
    check_all_was_searched(left, training.folder)
    assert holding(left, {PASSWORD.encode()}) == set()
    assert holding(left, {RunFolder(training.folder).secret()}) == {str(training.folder / "secret")}
