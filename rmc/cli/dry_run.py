"""``rmc train --dry-run``: a trial of some seconds, and what the run would need beside what the machine has."""

from pathlib import Path

from rich.console import Console
from rich.table import Table

from rmc.analysis.doctor import examine
from rmc.analysis.needs import Need, There, needs
from rmc.cli.signals import signals_caught
from rmc.common.errors import ConfigError
from rmc.deploy.local.trial import TRAINED_SECONDS, disk_bytes, run_trial, trial_config
from rmc.deploy.monitor.recorded import recorded_status
from rmc.deploy.monitor.table import plain_table
from rmc.deploy.redis.connect import connect
from rmc.deploy.redis.socket_folder import place_for_sockets
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.host import this_machine
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import check_start
from rmc.deploy.run.preflight import check_learner, check_port, ring_bytes_there
from rmc.deploy.run.tracking import choose_tracking
from rmc.deploy.run.validation import validate_launch

FITS, NOT, SLOWER = "ok", "DOES NOT FIT", "slower"


def dry_run(config: RunConfig, options: LaunchOptions, console: Console) -> int:
    """Try, measure, tell; 0 where it fits, else 1. Nothing is written in the run's folder. Raises ConfigError."""
    validate_launch(config, options)
    if options.launcher != "local":
        raise ConfigError("--dry-run", True, f"a trial needs --launcher local, not {options.launcher}")
    check_learner(config, options.device)
    check_port(options)
    choose_tracking(options)
    if options.redis_url is not None:
        connect(options.redis_url, "check")
    check_start(config, options)
    place_for_sockets()
    from rmc.analysis import evaluation  # imports torch

    trial = trial_config(config)
    shorter = f"a warm-up of {trial.replay.warmup_steps:,} steps and a ring of {trial.replay.capacity:,} windows"
    console.print(f"a trial trains for {TRAINED_SECONDS:.0f} s in a temporary folder, with {shorter}", soft_wrap=True)
    evaluation.initial_policy(config)  # as a run's launcher does before it trains, whose memory this is
    machine = this_machine((options.run_dir or Path("runs")).absolute())
    with signals_caught() as stop:
        measured = run_trial(trial, options.device, stop)
    rows = needs(config, measured, machine, _there_already(config, options))
    console.print(_table(rows))
    for finding in examine(measured.records, config):
        console.print(str(finding), soft_wrap=True)
    lacking = [row.what for row in rows if row.fits is False and row.is_needed]
    console.print(f"does not fit: {', '.join(lacking)}" if lacking else "it fits", soft_wrap=True)
    return 1 if lacking else 0


def _there_already(config: RunConfig, options: LaunchOptions) -> There:
    if options.run_dir is None or not options.goes_on:
        return There()
    folder = RunFolder(options.run_dir)
    return There(ring_bytes_there(config, options), disk_bytes(folder.checkpoints), recorded_status(folder).env_steps)


def _table(rows: list[Need]) -> Table:
    table = plain_table(("what", "needs", "this machine", ""))
    for row in rows:
        mark = "" if row.fits is None else FITS if row.fits else NOT if row.is_needed else SLOWER
        table.add_row(row.what, row.needs, row.has, mark, style="bold" if mark == NOT else "")
    return table
