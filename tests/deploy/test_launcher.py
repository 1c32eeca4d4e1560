"""What a local run's launcher makes of its end."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from rmc.cli import parser
from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.checkpoint import PROGRESS, CheckpointFolder
from rmc.common.process.role import StopSignal
from rmc.deploy.local import launcher
from rmc.deploy.monitor.monitor import Monitor
from rmc.deploy.run.folder import RunFolder


class Ended:
    """A run's processes whose learner has ended cleanly; Redis has lost what it said last."""

    def __init__(self, *_: object) -> None:
        self.bus = MemoryBus()
        self.supervisor: Any = SimpleNamespace(restarts=dict, start=self.close, stop=self.close)

    def finished(self) -> bool:
        return True

    def close(self) -> None:
        """Nothing runs."""


@pytest.mark.parametrize(("missing", "is_over"), [(0, True), (1, False)])
def test_a_run_whose_last_word_redis_has_lost_is_over_if_its_checkpoint_is(
    missing: int, is_over: bool, folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launcher, "LocalRun", Ended)
    config = folder.config()
    progress = json.dumps({"env_steps": config.total_steps - missing}).encode()
    CheckpointFolder(folder.checkpoints).save(7, {PROGRESS: progress})
    monitor = Monitor(folder, config, Console(quiet=True))
    assert launcher.train(config, folder, None, "cpu", monitor, StopSignal()) == is_over
    monitor.close()


def test_a_run_whose_name_begins_like_an_option_has_its_roles(folder: RunFolder) -> None:
    run = RunFolder(folder.path.rename(folder.path.with_name("-x")))
    commands = launcher.commands(run.config(), run, Path("/tmp"), "cpu")
    assert {command.words[1] for command in commands} == {"actor", "evaluator", "learner", "replay"}
    parsed: list[Any] = [parser.parse(list(command.words)) for command in commands]
    assert {command.role.run for command in parsed} == {run.name}
    assert run.name.startswith("-x-")
