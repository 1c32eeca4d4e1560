"""What each command does that looks at runs or an environment, without a policy: none imports torch before it must."""

from collections.abc import Sequence
from pathlib import Path

from rmc.analysis import curves, env_check, history
from rmc.analysis.out_file import NUMBERS, PICTURES, check_writable
from rmc.analysis.report import check_report, write_report
from rmc.analysis.report_run import ReportRun, told_apart
from rmc.analysis.run_paths import each_readable
from rmc.cli import run_options
from rmc.common.errors import ConfigError
from rmc.common.whole_file import write_whole
from rmc.deploy.monitor.view import terminal


def check_env(command: run_options.CheckEnv) -> int:
    if not 1 <= command.steps <= 10_000_000:
        raise ConfigError("--steps", command.steps, "take 1 to 10_000_000")
    return env_check.check(command.env.config(), command.steps, terminal())


def plot(command: run_options.Plot) -> int:
    check_writable("--out", command.out, (*PICTURES, NUMBERS))
    histories, console = _histories(command.runs), terminal(max(terminal().width, curves.WIDTH))
    groups = curves.grouped(histories)
    console.print(*curves.tables(groups, command.reference), sep="\n")
    if command.out.suffix.lower() == NUMBERS:
        write_whole(command.out, "".join(f"{one.to_line()}\n" for one in histories).encode())
    else:
        curves.draw(groups, command.by, command.out)
    console.print(f"{command.out}", soft_wrap=True)
    return 0


def _histories(paths: Sequence[Path]) -> list[history.History]:
    """Of all that can be read; the others are told. Raises ConfigError where that is none."""
    fix = "no history in there; give runs that were evaluated"
    histories = [one for its_own in each_readable(paths, history.read_histories, fix) for one in its_own]
    if not histories:
        raise ConfigError("RUNS", " ".join(map(str, paths)), fix)
    return histories


def report(command: run_options.Report) -> int:
    check_report(command.out)
    runs = told_apart(each_readable(command.runs, lambda path: ReportRun.read(path.resolve())))
    write_report(runs, command.out, command.video)
    size = command.out.stat().st_size
    terminal().print(f"{command.out}: {len(runs)} run{'s' * (len(runs) > 1)}, {size / 1e6:.1f} MB", soft_wrap=True)
    return 0
