"""The commands of docs/operating.md run as they are printed, in their order, on a run that trains meanwhile."""

import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from rmc import deploy
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.starts import starts
from tests.integration.running import free_port

PAGE = (Path(__file__).parents[2] / "docs" / "operating.md").read_text()
RMC = [sys.executable, "-m", "rmc.cli.main"]
ENDLESS = ("--total-steps", "10000000")


def done(at: Path, command: str, *more: str) -> str:
    words = shlex.split(command)
    words = [*(RMC if words[0] == "rmc" else words[:1]), *words[1:], *more]
    ended = subprocess.run(words, cwd=at, capture_output=True, text=True, timeout=150, check=False)
    assert (ended.returncode, ended.stderr) == (0, ""), ended.stdout + ended.stderr
    return ended.stdout


def env_steps(run: RunFolder) -> int:
    return max((int(record.get("env_steps", 0)) for record in run.records()), default=0)


@pytest.mark.timeout(600)
def test_a_run_is_operated_for_a_week(tmp_path: Path) -> None:
    train, stats, doctor, stop, resume, export, archive = re.findall(r"```sh\n(.*)\n```", PAGE)
    run = RunFolder(tmp_path / "runs" / "week")
    words = [*RMC, *train.replace("9464", str(free_port())).split()[1:], *ENDLESS]
    with subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as trained:
        while not any("updates" in record and record["updates"] > 0 for record in run.records()):
            assert trained.poll() is None
            time.sleep(0.5)
        assert "· training" in done(tmp_path, stats)
        assert "judged by the newest" in done(tmp_path, doctor)
        assert "rmc resume" in done(tmp_path, stop)
    total = env_steps(run) + 200
    done(tmp_path, resume, "--total-steps", str(total), "--metrics-port", "None")
    assert len(starts(run)) == 2
    done(tmp_path, export)
    done(tmp_path, archive)
    home = tmp_path / "home"
    home.mkdir()
    subprocess.run(["tar", "-xf", tmp_path / "week.tar.xz"], cwd=home, check=True)
    assert not (home / "runs" / "week" / "replay").exists()
    assert "return" in done(home, "rmc evaluate runs/week --episodes 1")
    done(home, resume, "--total-steps", str(total + 200))
    assert (RunFolder(home / "runs" / "week").result() or {})["env_steps"] >= total + 200


def test_every_alert_is_answered() -> None:
    rules = yaml.safe_load((Path(deploy.__file__).parent / "monitor" / "alerts.yaml").read_text())
    names = {rule["alert"] for group in rules["groups"] for rule in group["rules"]}
    assert set(re.findall(r"^\| `(Rmc\w+)` \|", PAGE, re.MULTILINE)) == names
