"""The commands of docs/report.md and docs/doctor.md run as they are printed."""

import re
import shutil
from pathlib import Path

import pytest

from rmc.analysis import doctor, run_faults
from rmc.analysis.bottleneck import IDLE, SATURATED
from rmc.deploy.local import trial
from tests.docs.running import DOCS, commands, ran

REPORT, DOCTOR = ((DOCS / name).read_text() for name in ("report.md", "doctor.md"))


TRAIN = "train InvertedPendulum-v5 --preset debug --total-steps 2000 --replay-ratio 64 --run-dir runs/first"


def test_their_commands_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "TRAINED_SECONDS", 2.0)
    ran(tmp_path, *TRAIN.split())
    shutil.copytree(tmp_path / "runs" / "first", tmp_path / "runs" / "second")
    printed = [*commands(REPORT), *commands(DOCTOR)]
    assert [words[0] for words in printed] == ["report", "report", "doctor", "train"]
    outputs = [ran(tmp_path, *words) for words in printed]
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
