"""A real training whose environment raises now and then, and hangs once: it goes on, and counts what it lost."""

import json
import re
from pathlib import Path

import pytest

from rmc.deploy.run.folder import RunFolder
from tests.integration.running import ENVIRONMENT, Training


def test_training_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mark = tmp_path / "hung"
    mark.touch()  # not yet: the launcher plays before it starts the roles
    monkeypatch.setattr("tests.integration.running.ENVIRONMENT", ENVIRONMENT | {"RMC_TEST_HANG": str(mark)})
    options = ("--total-steps", "1200", "--checkpoint-steps", "600", "--env-timeout", "5")
    with Training(tmp_path / "run", *options, env="tests.broken_env:Hanging-v0") as training:
        training.wait_for(lambda: "before training" in training.text())
        mark.unlink()
        assert training.finish(170) == 0, training.text() + training.logs()
        assert re.search(r"broken: \d+ episodes, by the environment's faults", training.text())
    assert mark.exists()
    logs = "".join(path.read_text() for path in (tmp_path / "run" / "logs").glob("*.log"))
    assert "rmc: ENV='tests.broken_env:Hanging-v0': step has not returned for 5 s (broken_env.py, line" in logs
    records = list(RunFolder(tmp_path / "run").records())
    assert max(record.get("broken_episodes", 0) for record in records) > 0
    assert max(record.get("restarts", 0) for record in records) >= 1
    assert 1200 <= json.loads((tmp_path / "run" / "result.json").read_bytes())["env_steps"] <= 1201
