"""``rmc report``."""

from rmc.analysis.report import check_report, write_report
from rmc.analysis.report_run import ReportRun
from rmc.analysis.run_paths import each_readable
from rmc.cli import run_options
from rmc.deploy.monitor.view import terminal


def report(command: run_options.Report) -> int:
    check_report(command.out)
    runs = each_readable(command.runs, lambda path: ReportRun.read(path.resolve()))
    write_report(runs, command.out, command.video)
    size = command.out.stat().st_size
    terminal().print(f"{command.out}: {len(runs)} run{'s' * (len(runs) > 1)}, {size / 1e6:.1f} MB", soft_wrap=True)
    return 0
