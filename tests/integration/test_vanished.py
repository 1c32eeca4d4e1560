"""Folders that vanish while a run is trained."""

import shutil
from pathlib import Path

from tests.integration.running import Training


def test_a_temporary_folder_that_vanishes_is_made_again(tmp_path: Path) -> None:
    """Roles that die later find Redis, the learner finds the replay server, and the run has its result."""
    with Training(tmp_path / "run", "--total-steps", "12000") as training:
        training.wait_for_updates()
        (folder,) = (path for path in training.sockets() if path.is_dir())
        shutil.rmtree(folder)
        training.wait_for(lambda: (folder / "redis.sock").exists() and (folder / "replay.sock").exists(), 30.0)
        actor = training.role("actor")
        assert actor is not None
        actor.kill()
        training.wait_for_updates(20)
        (folder / "replay.sock").unlink()
        training.wait_for(lambda: (folder / "replay.sock").exists(), 30.0)
        training.wait_for_updates(20)
        assert training.finish(120) == 0, training.text()
    assert (training.folder / "result.json").exists()
    assert "was removed; it is made again" in training.text()
