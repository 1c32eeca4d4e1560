"""``rmc report``."""

from collections.abc import Sequence
from pathlib import Path

from rmc.analysis.report import check_report, write_report
from rmc.analysis.report_run import ReportRun
from rmc.analysis.run_paths import each_readable, expanded
from rmc.cli import run_options
from rmc.common.errors import ConfigError
from rmc.deploy.monitor.view import terminal


def report(command: run_options.Report) -> int:
    """Write one page about runs."""
    if not command.runs:
        raise ConfigError("RUNS", "", "give folders of runs")
    check_report(command.out)
    runs = _read(command.runs)
    write_report(runs, command.out, command.video)
    size = command.out.stat().st_size
    terminal().print(f"{command.out}: {len(runs)} run{'s' * (len(runs) > 1)}, {size / 1e6:.1f} MB", soft_wrap=True)
    return 0


def _read(paths: Sequence[Path]) -> list[ReportRun]:
    """Each once; those that are no runs are told. Raises ConfigError where none is."""
    found = (path.resolve() for given in paths for path in expanded(given))
    reports = each_readable(found, ReportRun.read)
    if not reports:
        raise ConfigError("RUNS", " ".join(map(str, paths)), "none of them is a run's folder")
    return reports
