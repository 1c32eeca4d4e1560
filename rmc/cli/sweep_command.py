"""``rmc sweep``: from its checks to its table."""

import dataclasses
import logging
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import islice, product
from pathlib import Path
from typing import Any

from rmc.cli import sweep_check
from rmc.cli.signals import signals_caught
from rmc.cli.sweep_check import Checked
from rmc.cli.sweep_options import Sweep
from rmc.common.errors import STOPPED_STATUS, ConfigError
from rmc.common.extra import check_installed
from rmc.common.user_path import user_path
from rmc.deploy.monitor.view import terminal
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.host import cores as cores_here
from rmc.deploy.run.opening import plain_name
from rmc.deploy.run.option_names import option
from rmc.deploy.run.preflight import ring_bytes
from rmc.sweep import room
from rmc.sweep.grid import Grid, grid_jobs, is_finished, make_job
from rmc.sweep.index import NAME, Index
from rmc.sweep.job import TRIAL, Job
from rmc.sweep.local_runs import LocalRuns
from rmc.sweep.pool import OVER, Ending, Place, SweepPlan, conduct, drop_replay
from rmc.sweep.spec import Range, Search, Spec, read_grid, read_ranges, read_seeds, read_spec
from rmc.sweep.table import result_table, run_line

WIDEST = 1_000  # characters of a table's line
MOST_CORNERS = 64  # of a search, which are checked
log = logging.getLogger(__name__)


def sweep(command: Sweep) -> int:
    """Run what is missing of a sweep; 130 where it was stopped, 1 where a run has failed or was stopped."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    spec, folder = sweep_check.with_file(read_sweep(command)), command.sweep_dir or default_folder(command.what)
    if (folder / "config.json").exists():
        raise ConfigError("--sweep-dir", str(folder), "is a run's folder; give another")
    if command.jobs < 0:
        raise ConfigError("--jobs", command.jobs, "take 1 or more, or 0 for as many as fit")
    on_this_machine = command.launcher != "ray"
    if command.launcher == "lockstep":
        spec = dataclasses.replace(spec, words=(*spec.words, "--launcher=lockstep"))
    if on_this_machine and command.ray_address != "auto":
        raise ConfigError("--ray-address", command.ray_address, "give --launcher ray, or leave it")
    sweep_check.check_values(spec, on_this_machine)
    if not on_this_machine and "--threads" not in spec.said():  # by itself a learner would try all of a node's cores
        spec = dataclasses.replace(spec, words=("--threads=1", *spec.words))
    jobs = grid_jobs(spec, folder) if spec.search is None else corner_jobs(spec, spec.search, folder)
    checked = sweep_check.check_jobs(jobs, on_this_machine)
    with closing(Index(folder)) as index:
        if spec.search is None:
            work = grid_work(checked, index)
        else:
            work = search_work(spec, spec.search, checked[0].config, index, folder)
        return _conduct(command, work, checked, index)


def read_sweep(command: Sweep) -> Spec:
    """What is asked for, on the command line or in a file. Raises ConfigError."""
    if command.what.endswith(".toml"):
        names = ("seeds", "grid", "search", "trials", "sampler_seed", "prune")
        _check_usual(command, names, f"belongs into {command.what}, beside the rest of the sweep")
        return read_spec(user_path(command.what), command.train_words)
    search = None
    if not command.search:
        _check_usual(command, ("trials", "sampler_seed", "prune"), "is for a search; give --search, or leave it")
    else:
        search = Search(read_ranges(command.search), command.trials, command.sampler_seed, command.prune)
    seeds = read_seeds(command.seeds or "0")
    envs = tuple(env.strip() for env in command.what.split(","))
    return Spec(envs, seeds, {}, read_grid(command.grid), search, command.train_words)


def _check_usual(command: Sweep, names: Sequence[str], fix: str) -> None:
    usual = Sweep(command.what)
    for name in names:
        if (value := getattr(command, name)) != getattr(usual, name):
            raise ConfigError(option(name), value, fix)


def default_folder(what: str) -> Path:
    """The same for the same command, so that it goes on; of the first environment, so that others may be added."""
    name = Path(what).stem if what.endswith(".toml") else f"{plain_name(what.partition(',')[0])}__sweep"
    return Path("runs") / name


def corner_jobs(spec: Spec, search: Search, folder: Path) -> list[Job]:
    """Runs with each of a search's choices, and at its corners, to be checked."""
    ends = search.ends()
    count = max(map(len, ends.values()))
    each = [{name: values[min(at, len(values) - 1)] for name, values in ends.items()} for at in range(count)]
    corners = product(*((values[0], values[-1]) for values in ends.values()))
    points = each + [dict(zip(ends, values, strict=True)) for values in islice(corners, MOST_CORNERS)]
    return [make_job(spec, folder / f"{TRIAL}{at}", values, spec.seeds[0]) for at, values in enumerate(points)]


@dataclass(frozen=True)
class Work:
    """What a start of a sweep has to do."""

    plan: SweepPlan
    jobs: list[Job]  # that are known; a search's grow
    todo: list[Job]  # that are not over; of a search's new ones only the folders are known
    total: int


def grid_work(checked: list[Checked], index: Index) -> Work:
    """All runs that have no result yet. Raises ConfigError."""
    jobs = [one.job for one in checked]
    todo = [one.job for one in checked if not is_finished(one.job, one.config, one.options)]
    waiting = {job.name for job in todo}
    for job in jobs:
        if job.name not in waiting:
            index.put(job, "finished")
        elif index.state(job) in (*OVER, "running") or job.name not in index.lines:  # longer, killed, or new
            index.put(job, "waiting")
    index.write()
    return Work(Grid(todo), jobs, todo, len(jobs))


def search_work(spec: Spec, search: Search, config: RunConfig, index: Index, folder: Path) -> Work:
    """All trials that are missing. Raises ConfigError."""
    check_installed("optuna", ("optuna",), "search", "")
    from rmc.sweep.search import SearchPlan, distribution  # an extra

    distributions = {
        name: distribution(values, isinstance(values, Range) and sweep_check.is_integer(name, config))
        for name, values in search.ranges.items()
    }

    def make(name: str, values: dict[str, Any]) -> Job:
        job = make_job(spec, folder / name, values, spec.seeds[0])
        return sweep_check.as_planned(job, *sweep_check.read_job(job))

    def finished(job: Job) -> bool:
        return is_finished(job, *sweep_check.read_job(job))

    plan = SearchPlan(search, distributions, index, make, finished, config.learner.checkpoint_steps)
    for job in plan.todo:
        if index.state(job) in (*OVER, "running"):
            index.put(job, "waiting")
    index.write()
    total = max(search.trials, len(plan.jobs))
    new = [make_job(spec, folder / f"{TRIAL}{number}", {}, spec.seeds[0]) for number in range(len(plan.jobs), total)]
    return Work(plan, plan.jobs, [*plan.todo, *new], total)


def _conduct(command: Sweep, work: Work, checked: list[Checked], index: Index) -> int:
    console, folder, over = terminal(), checked[0].job.folder.parent, work.total - len(work.todo)

    def ended(job: Job, ending: Ending) -> None:
        nonlocal over
        over += 1
        index.end(job, ending)
        if command.drop_replay and ending.state in OVER:
            drop_replay(job)
        console.print(f"{over} of {work.total}: {run_line(job, index)}", soft_wrap=True)

    if command.drop_replay:
        for job in work.jobs:
            if index.state(job) in OVER:
                drop_replay(job)
    with signals_caught() as stop:
        if work.todo:
            with _place(command, work.todo, checked) as (place, about):
                summary = f"{_count(work.total, 'run')} in {folder}, {over} over; {about}"
                console.print(summary, soft_wrap=True)
                _warn_of_empty_rings(work.todo)
                conduct(work.plan, place, stop, index.begin, ended)
    if work.jobs:
        terminal(max(console.width, WIDEST)).print(result_table(work.jobs, index))  # a cut return is none
    remaining = work.total - sum(index.state(job) in OVER for job in work.jobs)
    if remaining:
        console.print(
            f"{remaining} not finished; the same command continues them; {folder / NAME} says why", soft_wrap=True
        )
    return STOPPED_STATUS if stop.requested else int(remaining > 0)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _warn_of_empty_rings(todo: list[Job]) -> None:
    begun = [job for job in todo if (job.folder / "checkpoints" / "epoch").exists()]
    empty = [job.name for job in begun if not RunFolder(job.folder).rings() and not _has_all_steps(job)]
    if empty:
        names = ", ".join(empty)
        log.warning("without their replay ring, these continue with --warmup-steps that are not trained on: %s", names)


def _has_all_steps(job: Job) -> bool:
    """Whether only its last evaluation is to be played again."""
    result = RunFolder(job.folder).result()
    return result is not None and result["env_steps"] >= sweep_check.read_job(job)[0].total_steps


@contextmanager
def _place(command: Sweep, todo: list[Job], checked: list[Checked]) -> Iterator[tuple[Place, str]]:
    """Where the runs run, and that in words. Raises ConfigError where there is no room for them."""
    lockstep = {one.options.launcher for one in checked} == {"lockstep"}
    cores = max(room.run_cores(one.config, lockstep) for one in checked)
    ring = max(ring_bytes(one.config) for one in checked)
    memory = max(room.run_memory(one.config, lockstep) for one in checked)
    gpus = int(any(one.options.device.startswith("cuda") for one in checked))
    if command.launcher != "ray":
        fit = 1 if gpus else room.runs_that_fit(cores, memory)
        fit = fit if lockstep else room.evenly(len(todo), fit)  # one thread of it uses no second core
        at_once = min(len(todo), command.jobs or fit)
        room.check_disk(todo[0].folder.parent, todo, ring, at_once, command.drop_replay)
        yield LocalRuns(at_once), f"{at_once} at a time, of {_count(cores_here(), 'core')}"
        return
    from rmc.deploy.ray.launcher import joined  # Ray is an extra, and slow to import
    from rmc.sweep.ray_runs import RayRuns

    with joined(command.ray_address, max(cores, cores_here())):
        place = RayRuns(cores, memory, gpus, command.jobs)
        yield place, f"up to {place.capacity()} at a time, each with {_count(cores, 'CPU')} of a node"
