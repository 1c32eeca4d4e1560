"""The commands of docs/missing-sensors.md run as they are printed."""

from pathlib import Path

import pytest

from rmc.common.env.config import EnvConfig
from rmc.deploy.run.folder import RunFolder
from tests.docs.test_resume import DOCS, execute

PAGE = (DOCS / "missing-sensors.md").read_text()


@pytest.mark.timeout(300)
def test_the_page_runs(tmp_path: Path) -> None:
    checked, _, played = execute(PAGE, tmp_path)
    assert "it can be trained on" in checked
    config = RunFolder(tmp_path / "runs" / "late").config()
    assert config.env == EnvConfig("InvertedPendulum-v5", flicker=0.3, flicker_burst=5.0, delay=1)
    seen, missing = played.splitlines()
    assert "InvertedPendulum-v5: return" in seen
    assert "with 30% of the frames missing" in missing
