"""The commands of docs/report.md and docs/doctor.md run as they are printed."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rmc.analysis import doctor, run_faults
from rmc.analysis.bottleneck import IDLE, SATURATED

DOCS = Path(__file__).parents[2] / "docs"
REPORT, DOCTOR = ((DOCS / name).read_text() for name in ("report.md", "doctor.md"))


def ran(command: str, folder: Path) -> str:
    words = [sys.executable, "-m", "rmc.cli.main", *command.split()[1:]]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=150, check=False)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    return done.stdout


@pytest.mark.timeout(400)
def test_their_commands_run(tmp_path: Path) -> None:
    ran(
        "rmc train InvertedPendulum-v5 --preset debug --total-steps 2000 --replay-ratio 64 --run-dir runs/first",
        tmp_path,
    )
    shutil.copytree(tmp_path / "runs" / "first", tmp_path / "runs" / "second")
    commands = [command for page in (REPORT, DOCTOR) for command in re.findall(r"```sh\n(rmc .*)\n```", page)]
    assert [command.split()[1] for command in commands] == ["report", "report", "doctor", "train"]
    outputs = [ran(command, tmp_path) for command in commands]
    assert outputs[0].startswith("report.html: 1 run, ")
    assert outputs[1].startswith("both.html: 2 runs, ")
    assert "learner-bound: actors waited " in outputs[2]
    assert outputs[3].splitlines()[-1] == "it fits"
    for row in re.findall(r"^\| (memory|disk|bandwidth|file handles|threads|time to the end)\b", DOCTOR, re.MULTILINE):
        assert row in outputs[3]


def test_every_finding_is_on_its_page_with_its_limits() -> None:
    source = "".join(path.read_text() for path in (DOCS.parent / "analysis").glob("*.py"))
    findings = set(re.findall(r'Finding\(\s*"([^"]+)"', source))
    assert findings == set(re.findall(r"^\| `([\w -]+)` \|", DOCTOR, re.MULTILINE))
    assert f"busy {SATURATED:.0%}".replace("%", " %") in DOCTOR
    assert f"from {IDLE:.0%} of the time".replace("%", " %") in DOCTOR
    assert f"{run_faults.STALLED_SECONDS:.0f} s without a step" in DOCTOR
    assert f"nothing for {run_faults.SILENT_SECONDS:.0f} s" in DOCTOR
    assert f"trained for {doctor.LEAST_SECONDS:.0f} seconds" in DOCTOR
