"""``rmc train`` from its checks to ``result.json``."""

import shlex
import traceback
from contextlib import AbstractContextManager, nullcontext
from statistics import mean
from typing import Any

from rich.console import Console

from rmc.cli.ending import format_evaluation, print_result, print_stopped
from rmc.cli.signals import signals_caught, signals_interrupt
from rmc.common.bus.metrics_record import is_complete
from rmc.common.checkpoint import POLICY, CheckpointFolder
from rmc.common.errors import CONFIG_STATUS, STOPPED_STATUS, ConfigError, RmcError
from rmc.common.process.role import StopSignal
from rmc.deploy.local import launcher
from rmc.deploy.monitor.monitor import Monitor
from rmc.deploy.monitor.output import Output
from rmc.deploy.monitor.recorded import Callback, empty_status
from rmc.deploy.monitor.tracker import start_tracker
from rmc.deploy.redis.connect import connect
from rmc.deploy.redis.socket_folder import place_for_sockets
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.memory_reach import reach_note
from rmc.deploy.run.opening import open_run
from rmc.deploy.run.preflight import check_machine
from rmc.deploy.run.starts import resume_command
from rmc.deploy.run.validation import validate_launch


def train(
    config: RunConfig, options: LaunchOptions, console: Console, callback: Callback | None = None
) -> tuple[RunFolder, int]:
    """Train to the end, or to a stop signal; the run's folder, which may be a new one, and its exit status.

    ``callback`` hears the roles' records. Raises ConfigError before anything is started.
    """
    if options.launcher == "ray":
        from rmc.cli import ray_training  # Ray is an extra, and slow to import

        return ray_training.train(config, options, console, callback)
    folder = open_folder(config, options)
    return folder, conduct(config, folder, options, console, callback)


def open_folder(config: RunConfig, options: LaunchOptions) -> RunFolder:
    """The run's folder, locked, once all is checked that needs no process. Raises ConfigError."""
    validate_launch(config, options)
    try:
        check_machine(config, options)
    except ConfigError:
        if options.goes_on and options.run_dir is not None:
            RunFolder(options.run_dir).lock.check_untrained()  # by whom its port and memory would be taken
        raise
    if options.launcher == "local":
        place_for_sockets()
    if options.redis_url is not None:
        connect(options.redis_url, "check")
    return open_run(config, options)


def conduct(
    config: RunConfig, folder: RunFolder, options: LaunchOptions, console: Console, callback: Callback | None = None
) -> int:
    """Be the launcher of a run whose folder is locked, from its first evaluation to its last."""
    Output.log = folder.logs / "launcher.log"
    with signals_interrupt():
        try:
            return _conduct(config, folder, options, console, callback)
        except KeyboardInterrupt:  # before the first word: who waits for its end hears that it was stopped
            folder.lock.release(STOPPED_STATUS)
            raise
        except Exception as error:  # whoever comes back to a closed terminal finds it there
            if options.launcher != "ray":  # on Ray all that is printed goes there
                Output.keep(f"{error}\n" if isinstance(error, RmcError) else traceback.format_exc())
            raise


def _conduct(
    config: RunConfig, folder: RunFolder, options: LaunchOptions, console: Console, callback: Callback | None
) -> int:
    status, tracker, monitor = 1, None, None
    end: dict[str, Any] = {"state": "failed"}
    try:
        console.print(f"run folder {folder.path}", soft_wrap=True)
        if note := reach_note(config):
            console.print(note, soft_wrap=True)
        if (result := folder.result()) is not None:  # no step is missing: it would be gone else
            text = f"all {result['env_steps']:,} steps are trained; {resume_command(folder)} --total-steps N goes on"
            console.print(text, soft_wrap=True)
            if is_complete(result):
                status = 0
                return print_result(folder, console)
        by_clock = options.launcher != "lockstep"
        seconds = config.evaluator.evaluation_seconds if by_clock else 0.0
        before = _before(config, folder, seconds, console)
        console.print(f"before training: {format_evaluation(before)}")
        tracker = start_tracker(folder)
        monitor = Monitor(folder, config, console, tracker, callback)
        if not _trained(config, folder, options, monitor, console):
            raise KeyboardInterrupt
        result = _result(folder, seconds, monitor, before, console)
        folder.write_result(result)
        status, end = 0, {"state": "finished", **result}
        if tracker is not None:
            end["video"] = _video(config, folder, console)
    except ConfigError:
        status = CONFIG_STATUS
        raise
    except KeyboardInterrupt:  # also amid the first evaluation, or the last
        status, end = STOPPED_STATUS, {"state": "stopped"}
        return print_stopped(folder, (monitor.status if monitor else empty_status(folder)).env_steps, console)
    finally:
        try:
            if tracker is not None:
                tracker.close(end)
        finally:  # a second Ctrl-C may end what a tracker still sends
            folder.lock.release(status)
    console.print(f"before training: {format_evaluation(before)}")
    return print_result(folder, console)


def _trained(config: RunConfig, folder: RunFolder, options: LaunchOptions, monitor: Monitor, console: Console) -> bool:
    """Train, with what others need to take part said before; whether that came to its end. Closes the monitor."""
    if options.metrics_port is not None:
        console.print(f"metrics on {options.metrics_host}, port {options.metrics_port}", soft_wrap=True)
    if options.launcher == "manual":
        console.print(f"start the roles with --run={shlex.quote(folder.name)}", soft_wrap=True)
    try:
        # before and after, nothing runs that Ctrl-C could not end at once
        with signals_caught() as stop, _metrics_served(folder, monitor, options):
            return _launch(config, folder, options, monitor, stop) and not stop.requested
    finally:
        monitor.close()


def _metrics_served(folder: RunFolder, monitor: Monitor, options: LaunchOptions) -> AbstractContextManager[None]:
    if options.metrics_port is None:
        return nullcontext()
    from rmc.deploy.monitor import exporter  # every role would hold a web server

    return exporter.served(monitor.status, folder.name, options)


def _video(config: RunConfig, folder: RunFolder, console: Console) -> str | None:
    """The final policy filmed, where that can be done here; else why not is said."""
    from rmc.analysis import video  # imports torch
    from rmc.analysis.policy import load_policy

    out = folder.path / "video.mp4"
    try:
        video.prepare(config.env, out)
        console.print("filming an episode; Ctrl-C leaves it out")
        video.record(load_policy(folder.path), config.env, config.seed, out)
    except KeyboardInterrupt:
        return None
    except (RmcError, OSError) as error:
        console.print(f"no video: {error}", soft_wrap=True)
        return None
    return str(out)


def _launch(config: RunConfig, folder: RunFolder, options: LaunchOptions, monitor: Monitor, stop: StopSignal) -> bool:
    if options.launcher == "local":
        return launcher.train(config, folder, options.redis_url, options.device, monitor, stop)

    if options.launcher == "ray":
        from rmc.deploy.ray import launcher as ray_launcher  # Ray is an extra, and slow to import
        from rmc.deploy.ray import run

        with ray_launcher.joined(options.ray_address):
            return run.train(config, folder, options.device, options.all_cpus, options.tls, monitor, stop)

    if options.launcher == "manual":
        assert options.redis_url is not None  # validate_launch has seen to it
        return launcher.attend(config, folder, options.redis_url, monitor, stop)

    import torch

    from rmc.deploy.local import lockstep

    torch.set_num_threads(config.learner.threads or 1)  # the bits may depend on it, so it must not on the machine
    lockstep.train(config, folder.path, monitor.watch, stop, options.device)
    return True


def _before(config: RunConfig, folder: RunFolder, seconds: float, console: Console) -> dict[str, Any]:
    """How the policy plays that the run begins with: at its first start it does so, later ones read it."""
    kept = folder.initial()
    if kept is not None:
        return kept
    from rmc.analysis import evaluation  # imports torch
    from rmc.analysis.policy_file import PolicyFile

    number, files = CheckpointFolder(folder.checkpoints).latest() or (0, {})
    blob = files[POLICY] if files and number == 0 else evaluation.initial_policy(config)
    policy = PolicyFile(config.policy_header(), blob)
    progress = evaluation.EvaluationProgress(console, "before training")
    played = evaluation.evaluate_policy(policy, evaluation.FINAL_EPISODES, None, seconds, progress)
    folder.write_initial(played)
    return played


def _result(
    folder: RunFolder, seconds: float, monitor: Monitor, before: dict[str, Any], console: Console
) -> dict[str, Any]:
    from rmc.analysis.evaluation import FINAL_EPISODES, EvaluationProgress, evaluate_policy
    from rmc.analysis.policy_file import read_policy

    wall_s, progress = monitor.wall_seconds, EvaluationProgress(console, "after training")
    after = evaluate_policy(read_policy(folder.path), FINAL_EPISODES, None, seconds, progress)
    return {
        **after,
        "initial_return_mean": before["eval_return_mean"],
        "wall_s": wall_s,
        "replay_ratio": monitor.status.replay("replay_ratio", mean),
        "restarts": sum(monitor.restarts().values()),
    }
