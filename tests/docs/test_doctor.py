"""docs/doctor.md has every finding; its commands and those of docs/report.md run in tests/analysis/test_report.py."""

import re

from rmc.analysis import doctor, run_faults
from rmc.analysis.bottleneck import IDLE, SATURATED
from tests.docs.running import DOCS

DOCTOR = (DOCS / "doctor.md").read_text()


def test_every_finding_is_on_its_page_with_its_limits() -> None:
    source = "".join(path.read_text() for path in (DOCS.parent / "analysis").glob("*.py"))
    findings = set(re.findall(r'Finding\(\s*"([^"]+)"', source))
    assert findings == set(re.findall(r"^\| `([\w -]+)` \|", DOCTOR, re.MULTILINE))
    assert f"busy {SATURATED:.0%}".replace("%", " %") in DOCTOR
    assert f"from {IDLE:.0%} of the time".replace("%", " %") in DOCTOR
    assert f"{run_faults.STALLED_SECONDS:.0f} s without a step" in DOCTOR
    assert f"nothing for {run_faults.SILENT_SECONDS:.0f} s" in DOCTOR
    assert f"trained for {doctor.LEAST_SECONDS:.0f} seconds" in DOCTOR
