"""The commands of docs/missing-sensors.md run as they are printed."""

from pathlib import Path

from rmc.common.env.config import EnvConfig
from rmc.deploy.run.folder import RunFolder
from tests.docs.running import DOCS, LOCKSTEP, commands, ran

PAGE = (DOCS / "missing-sensors.md").read_text()


def test_the_page_runs(tmp_path: Path) -> None:
    check, train, evaluate = commands(PAGE)
    checked = ran(tmp_path, *check)
    ran(tmp_path, *train, *LOCKSTEP, "--total-steps", "700")
    played = ran(tmp_path, *evaluate)
    assert "it can be trained on" in checked
    config = RunFolder(tmp_path / "runs" / "late").config()
    assert config.env == EnvConfig("InvertedPendulum-v5", flicker=0.3, flicker_burst=5.0, delay=1)
    seen, missing = played.splitlines()
    assert "InvertedPendulum-v5: return" in seen
    assert "with 30% of the frames missing" in missing
