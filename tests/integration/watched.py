"""A run that is watched for words that must not be seen anywhere."""

from contextlib import suppress
from pathlib import Path

import psutil

from tests.integration.running import Training

COMMANDS = ("main train", "main role actor", "main role evaluator", "main role learner", "main role replay")


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
