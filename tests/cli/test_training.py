"""What rmc train does around the roles."""

import json

from rich.console import Console

from rmc.analysis import evaluation
from rmc.cli import training
from rmc.cli.training import conduct
from rmc.common.checkpoint import CheckpointFolder
from rmc.deploy.run.launch_options import LaunchOptions
from tests.analysis.test_policy import AGENTS, make_run


def test_the_last_evaluation_judges_and_does_not_choose(tmp_path, monkeypatch):
    """The best is of those that were evaluated from other starts."""
    folder = make_run(tmp_path / "run", AGENTS["robust"], "InvertedPendulum-v5")
    monkeypatch.setattr(training, "_launch", lambda *_: True)
    placement = LaunchOptions(folder.path, "resume", "local", "cpu", None)
    folder.lock()
    assert conduct(folder.config(), folder, placement, Console(quiet=True)) == 0
    assert json.loads(folder.result_file.read_bytes())["updates"] == 7
    assert CheckpointFolder(folder.checkpoints).best() is None


def test_the_untrained_policy_is_played_once(tmp_path, monkeypatch):
    """Its result is read at a resume; where that is damaged, it is played again."""
    folder = make_run(tmp_path / "run", AGENTS["robust"], "InvertedPendulum-v5")
    monkeypatch.setattr(training, "_launch", lambda *_: True)
    placement = LaunchOptions(folder.path, "resume", "local", "cpu", None)
    played, play = [], evaluation.evaluate_blob

    def counted(config, blob, episodes, flicker=None):
        played.append(blob)
        return play(config, blob, episodes, flicker)

    monkeypatch.setattr(evaluation, "evaluate_blob", counted)

    def train() -> float:
        """How often a policy was played, with the last's; what the result says of the untrained one."""
        played.clear()
        folder.lock()
        assert conduct(folder.config(), folder, placement, Console(quiet=True)) == 0
        return json.loads(folder.result_file.read_bytes())["initial_return_mean"]

    first = train()
    assert len(played) == 2
    kept = folder.initial_file.read_bytes()
    said = {**json.loads(kept), "eval_return_mean": first + 1}  # told apart from one that is played
    folder.initial_file.write_text(json.dumps(said))
    assert (train(), len(played)) == (first + 1, 1)
    for damaged in (b"", kept[:20], b"[]", b'{"eval_return_mean": "x"}', b"\xff"):
        folder.initial_file.write_bytes(damaged)
        assert (train(), len(played)) == (first, 2)
        assert folder.initial_file.read_bytes() == kept
    folder.initial_file.unlink()
    assert (train(), len(played)) == (first, 2)
