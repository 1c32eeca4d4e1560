"""What the commands that train, watch and end a run do."""

import dataclasses
import json
import logging
import shlex

from rmc.analysis import run_list
from rmc.analysis.doctor import examine_run
from rmc.cli import run_options, train_options, training
from rmc.cli.dry_run import dry_run
from rmc.cli.ending import print_end
from rmc.common.extra import check_installed
from rmc.deploy.monitor import attach as attachment
from rmc.deploy.monitor.recorded import recorded_status, status_json
from rmc.deploy.monitor.table import table
from rmc.deploy.monitor.view import terminal
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.starts import format_starts


def train(command: train_options.Train) -> int:
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    if command.dry_run:
        return dry_run(command.config(), command.launch_options(), terminal())
    return training.train(command.config(), command.launch_options(), terminal())[1]


def stats(command: run_options.Stats) -> int:
    folder, console = RunFolder(command.run), terminal()
    status = recorded_status(folder)
    if command.json:
        console.print(json.dumps(status_json(folder, status)), soft_wrap=True)
        return 0
    console.print(table(status, console.width))
    if history := format_starts(folder):
        console.print(history, soft_wrap=True)
    if (result := folder.result()) is not None:
        console.print_json(data=result)
    return 0


def list_runs(command: run_options.List) -> int:
    if command.ray_address is not None:
        _check_ray(command.ray_address)
        from rmc.cli import cluster_commands

        return cluster_commands.list_runs(command.ray_address, command.json)
    console, summaries = terminal(), run_list.runs(command.folder)
    if command.json:
        console.print(json.dumps([dataclasses.asdict(one) for one in summaries]), soft_wrap=True)
        return 0
    console.print(run_list.table(summaries, command.folder, console.width))
    for one in summaries:
        if one.fault is not None:
            console.print(one.fault, soft_wrap=True)
    return 0


def _check_ray(address: str) -> None:
    check_installed("ray", ("ray",), "--ray-address", address)


def doctor(command: run_options.Doctor) -> int:
    findings, seconds = examine_run(RunFolder(command.run))
    console = terminal()
    for finding in findings:
        console.print(str(finding), soft_wrap=True)
    if not findings:
        console.print("nothing found: no share of time was recorded that could be judged")
    console.print(f"judged by the newest {seconds:,.0f} s of training")
    return 0


def attach(command: run_options.Attach) -> int:
    folder, console = RunFolder(command.run), terminal()
    attachment.launcher_pid(folder)
    try:
        attachment.watch(folder, console, attachment.LauncherGone(folder))
    except KeyboardInterrupt:
        console.print(f"it goes on; rmc stop {shlex.quote(str(command.run))} ends it", soft_wrap=True)
        return 0
    return print_end(folder, console)


def stop(command: run_options.Stop) -> int:
    if command.ray_address is not None:
        _check_ray(command.ray_address)
        from rmc.cli import cluster_commands

        return cluster_commands.stop(str(command.run), command.ray_address)
    folder = RunFolder(command.run)
    attachment.stop(folder)
    if folder.is_baseline():  # its own terminal says how
        terminal().print(f"{folder.path} has ended", soft_wrap=True)
        return 0
    print_end(folder, terminal())
    return 0


def cluster(command: run_options.Cluster) -> int:
    check_installed("ray", ("ray", "yaml"), "CONFIG", str(command.config))
    from rmc.deploy.ray import machines  # needs what only the extra "ray" installs

    act = machines.up if command.action == "up" else machines.down
    act(command.config, terminal())
    return 0
