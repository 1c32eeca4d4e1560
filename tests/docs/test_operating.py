"""The commands of docs/operating.md run as they are printed, in their order, on a run that trains meanwhile."""

import re
import shlex
import subprocess
import time
from pathlib import Path

import pytest
import yaml

from rmc import deploy
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.starts import starts
from tests.command import COMMAND
from tests.docs.running import DOCS, LOCKSTEP, commands, ran
from tests.integration.running import free_port

PAGE = (DOCS / "operating.md").read_text()
LOOKED_AT_SECONDS, LEAST_SECONDS = 2.0, 0.5  # of training, and those that the doctor wants


def trained_seconds(run: RunFolder) -> float:
    """That its learner's records span."""
    times = [float(record["time"]) for record in run.records() if record.get("updates", 0) > 0]
    return max(times) - min(times) if times else 0.0


def env_steps(run: RunFolder) -> int:
    return max((int(record.get("env_steps", 0)) for record in run.records()), default=0)


@pytest.mark.timeout(600)
def test_a_run_is_operated_for_a_week(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmc.analysis.doctor.LEAST_SECONDS", LEAST_SECONDS)
    train, stats, doctor, stop, resume, export = commands(PAGE)
    archive = re.findall(r"```sh\n(tar .*)\n```", PAGE)[0]
    run = RunFolder(tmp_path / "runs" / "week")
    words = [*COMMAND, *train[:-1], str(free_port())]
    with subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as trained:
        try:
            while trained_seconds(run) < LOOKED_AT_SECONDS:
                assert trained.poll() is None
                time.sleep(0.5)
            assert "· training" in ran(tmp_path, *stats)
            assert "judged by the newest" in ran(tmp_path, *doctor)
            assert "rmc resume" in ran(tmp_path, *stop)
        finally:
            trained.terminate()
    total = env_steps(run) + 200
    ran(tmp_path, *resume, "--total-steps", str(total), "--metrics-port", "None", *LOCKSTEP)
    assert len(starts(run)) == 2
    ran(tmp_path, *export)
    subprocess.run(shlex.split(archive), cwd=tmp_path, check=True)
    home = tmp_path / "home"
    home.mkdir()
    subprocess.run(["tar", "-xf", tmp_path / "week.tar.xz"], cwd=home, check=True)
    assert not (home / "runs" / "week" / "replay").exists()
    assert "return" in ran(home, "evaluate", "runs/week", "--episodes", "1")
    lost = r"replay: the ring of \d+ windows is lost; begins empty at agent step \d+"
    ran(home, *resume, "--total-steps", str(total + 200), warning=lost)
    assert (RunFolder(home / "runs" / "week").result() or {})["env_steps"] >= total + 200


def test_every_alert_is_answered() -> None:
    rules = yaml.safe_load((Path(deploy.__file__).parent / "monitor" / "alerts.yaml").read_text())
    names = {rule["alert"] for group in rules["groups"] for rule in group["rules"]}
    assert set(re.findall(r"^\| `(Rmc\w+)` \|", PAGE, re.MULTILINE)) == names
