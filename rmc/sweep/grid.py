"""All runs of a grid, and which of them are over."""

from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import Any

from rmc.common.bus.metrics_record import is_complete
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import LAST_EVALUATION, SAME_AGENT
from rmc.deploy.run.option_names import flat, option, option_words
from rmc.deploy.run.starts import begun_with, format_begun
from rmc.sweep.job import Job, run_name
from rmc.sweep.pool import Ending
from rmc.sweep.spec import Spec


def grid_jobs(spec: Spec, folder: Path) -> list[Job]:
    """Each value with each other, seed by seed, so that what is compared goes on side by side."""
    varied = {"env": list(spec.envs)} if len(spec.envs) > 1 else {}
    varied |= spec.grid
    points = [dict(zip(varied, values, strict=True)) for values in product(*varied.values())]
    return [make_job(spec, folder / run_name(values, seed), values, seed) for seed in spec.seeds for values in points]


def make_job(spec: Spec, folder: Path, values: dict[str, Any], seed: int) -> Job:
    """The run of some values and a seed; of the first environment, where they name none."""
    options = [word for name, value in spec.options.items() for word in option_words(name, value)]
    own = [word for name, value in values.items() if name != "env" for word in option_words(name, value)]
    words = ("train", values.get("env", spec.envs[0]), *options, *spec.words, *own, "--seed", str(seed))
    return Job(folder, words, seed, values)


def is_finished(job: Job, config: RunConfig, options: LaunchOptions) -> bool:
    """Whether its run has a result after as many steps. Raises ConfigError where the folder has another run.

    A last evaluation that was cut is played again where an option of it has changed: else it would be cut again.
    """
    folder = RunFolder(job.folder)
    if not (folder.path / "config.json").exists():
        return False
    was, now = flat(folder.config()), flat(config)
    changed = {path for path in now if was.get(path) != now[path]}
    for path in now:
        if path in changed - SAME_AGENT:
            fix = f"the run in {job.folder} has {was.get(path)!r}; use that, or another --sweep-dir"
            raise ConfigError("seeds" if path == "seed" else option(path), now[path], fix)
    asked = None if options.init_from is None else [options.init_from, options.init_parts]
    if begun_with(folder).get("asked") != asked:
        fix = f"the run in {job.folder} began {format_begun(folder)}; use that, or another --sweep-dir"
        raise ConfigError("--init-from", options.init_from, fix)
    if (result := folder.result()) is None:
        return False
    if was["total_steps"] > config.total_steps:
        fix = f"the run in {job.folder} has {was['total_steps']}; use that or more, or another --sweep-dir"
        raise ConfigError("--total-steps", config.total_steps, fix)
    played_again = not is_complete(result) and changed and changed <= LAST_EVALUATION
    return result["env_steps"] >= config.total_steps and not played_again


class Grid:
    """A plan of runs that are known beforehand."""

    def __init__(self, jobs: Iterable[Job]) -> None:
        self._jobs = iter(jobs)

    def next(self) -> Job | None:
        return next(self._jobs, None)

    def is_hopeless(self, job: Job) -> bool:  # noqa: ARG002 - none is
        """Each goes to its end."""
        return False

    def end(self, job: Job, ending: Ending) -> None:
        """Nothing depends on it."""
