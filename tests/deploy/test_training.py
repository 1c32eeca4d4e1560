"""What rmc train does around the roles."""

import json

from rich.console import Console

from rmc.cli import training
from rmc.cli.training import conduct
from rmc.common.checkpoint import CheckpointFolder
from rmc.deploy.run.launch_options import LaunchOptions
from tests.deploy.test_policy import AGENTS, make_run


def test_the_last_evaluation_judges_and_does_not_choose(tmp_path, monkeypatch):
    """The best is of those that were evaluated from other starts."""
    folder = make_run(tmp_path / "run", AGENTS["robust"], "InvertedPendulum-v5")
    monkeypatch.setattr(training, "_launch", lambda *_: True)
    placement = LaunchOptions(folder.path, "resume", "local", "cpu", None)
    folder.lock()
    assert conduct(folder.config(), folder, placement, Console(quiet=True)) == 0
    assert json.loads(folder.result_file.read_bytes())["updates"] == 7
    assert CheckpointFolder(folder.checkpoints).best() is None
