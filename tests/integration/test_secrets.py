"""What a real run leaves or shows, searched for every password of its Redis and for its secret."""

import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

from rmc.deploy.redis.server import server_binary
from rmc.deploy.redis.users import LAUNCHER, RedisUsers
from rmc.deploy.run.folder import RunFolder
from tests.integration.running import Training
from tests.integration.telling_env import TELLS

TELLING, PLAYERS = "tests.integration.telling_env:Telling-v0", ("actor", "evaluator")  # beside the launcher
COMMANDS = ("main train", "main role actor", "main role evaluator", "main role learner", "main role replay")
ENDLESS = ("--total-steps", "100000000", "--checkpoint-steps", "500")
PASSWORD = "hunter2-of-the-users-own-redis"


class Watched(Training):
    """Keeps the command lines of all its processes and what stands beside its sockets, whenever it is waited for."""

    def look(self) -> None:
        """Once."""
        self.seen: dict[str, bytes] = getattr(self, "seen", {})
        for process in [self.launcher, *self.launcher.children(recursive=True)]:
            with suppress(psutil.NoSuchProcess):
                words = " ".join(process.cmdline())
                self.seen[words] = words.encode()
        for path in self.sockets():
            if path.is_file():
                self.seen[str(path)] = path.read_bytes()

    def go_on(self, updates: int) -> None:
        """So many updates more, and on until every process was seen."""
        goal = self.newest("learner", "updates") + updates
        self.wait_for(lambda: (self.look(), self.newest("learner", "updates") >= goal and not self.unseen())[1])

    def unseen(self) -> list[str]:
        """Processes whose command lines were not."""
        return [command for command in COMMANDS if not any(command in name for name in self.seen)]

    def lose_redis(self) -> None:
        """Until a role tells of it: one that comes back within a retry is not noticed."""
        for _ in range(5):
            redis = self.role("redis")
            assert redis is not None
            redis.kill()
            self.go_on(20)
            if "Redis is back" in self.text() + self.logs():
                return
        raise AssertionError(f"no role tells of a lost Redis:\n{self.logs()}")

    def left(self) -> dict[str, bytes]:
        """All that was seen, all that it printed, and every file in its folder."""
        files = {str(path): path.read_bytes() for path in (self.output, *self.folder.rglob("*")) if path.is_file()}
        return self.seen | files


def holding(left: dict[str, bytes], words: set[bytes]) -> set[str]:
    """Where one of these words stands."""
    return {name for name, content in left.items() if any(word in content for word in words)}


def check_all_was_searched(left: dict[str, bytes], folder: Path) -> None:
    """Every kind of what a run leaves or shows was among it."""
    for name in ("config.json", "metrics.jsonl", "logs/learner.log", "logs/actor-0.log", "logs/evaluator.log"):
        assert str(folder / name) in left
    for part in ("events.out.tfevents", "checkpoints/", ".out", *COMMANDS):
        assert any(part in name for name in left), part


def test_passwords_and_secret_of_an_embedded_redis_are_nowhere(tmp_path: Path) -> None:
    """Nor after it was killed, of which all roles tell; the secret stands in its own file."""
    with Watched(tmp_path / "run", *ENDLESS) as training:
        training.go_on(1)
        training.lose_redis()
        training.interrupt()
    run = RunFolder(training.folder)
    users = RedisUsers(run.name, run.secret(), run.config().roles())
    passwords = {users.password(user).encode() for user in (LAUNCHER, *users.roles)}
    left = training.left()
    check_all_was_searched(left, training.folder)
    assert any(name.endswith("users.acl") for name in left)
    assert holding(left, passwords) == set()
    assert holding(left, {run.secret()}) == {str(run.secret_file)}


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
