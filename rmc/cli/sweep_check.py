"""A sweep's options, judged by the parser of ``rmc train`` before anything starts."""

import contextlib
import dataclasses
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rmc.cli import complaint, config_file, parser
from rmc.cli.train_options import Train
from rmc.common.bus.redis_url import value_without_passwords, without_passwords
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import check_start
from rmc.deploy.run.option_names import flag, flat, option, option_words
from rmc.deploy.run.preflight import check_machine
from rmc.deploy.run.tracking import choose_tracking
from rmc.deploy.run.validation import validate, validate_launch
from rmc.sweep.job import Job
from rmc.sweep.spec import EVERY_RUNS, Range, Search, Spec, check_name


@dataclass(frozen=True)
class Checked:
    """A run that can be started."""

    job: Job
    config: RunConfig
    options: LaunchOptions


def with_file(spec: Spec) -> Spec:
    """The sweep with the options of the file of ``--config``, read once: runs may start when it says something else.

    Raises ConfigError.
    """
    path = config_file.named(spec.words)
    if path is None:
        return spec
    words: list[str] = []
    for name, value in config_file.read_options(path, parser.option_names(Train))[1].items():
        check_name(f"{config_file.OPTION} {path}: {name}", name, value, EVERY_RUNS)
        if option(name) not in spec.said():
            words += option_words(name, value)
    return dataclasses.replace(spec, words=(*words, *config_file.without_file(spec.words)))


def check_values(spec: Spec, on_this_machine: bool) -> None:
    """Raises ConfigError, which names the key, for the first value that rmc train would not read."""
    given = set(map(flag, spec.words))
    typed = " ".join(map(without_passwords, spec.words))
    if not on_this_machine and "--init-from" in spec.said():
        raise ConfigError("--init-from", typed, "the nodes do not have that file; leave it")
    if "--seed" in given:
        raise ConfigError("--seed", typed, "a sweep has several: give --seeds")
    for name in parser.option_names(Train):
        if name not in EVERY_RUNS and option(name) in given:
            raise ConfigError(option(name), typed, "a sweep's runs are given none; leave it")
    _check("options of rmc train", typed, spec, list(spec.words))
    search, options = spec.search or Search({}), {name: [value] for name, value in spec.options.items()}
    for name, sought in search.ranges.items():
        if isinstance(sought, Range):
            is_integer(name, read_job(Job(Path(), ("train", spec.envs[0], *spec.words), 0))[0])
    for part, values in (("options", options), ("grid", spec.grid), ("search", search.ends())):
        for name, tried in values.items():
            for value in tried:
                _check(f"{part}.{name}", value, spec, option_words(name, value))


def _check(place: str, value: Any, spec: Spec, words: list[str]) -> None:
    with contextlib.redirect_stderr(io.StringIO()), contextlib.suppress(SystemExit):
        parser.parse(["train", spec.envs[0], *words])
        return
    told = [without_passwords(word) for word in words]  # the complaint quotes them
    fault = complaint.about(["train", spec.envs[0], *told], ["sweep", *told])
    raise ConfigError(place, value_without_passwords(value), fault)


def check_jobs(jobs: Sequence[Job], on_this_machine: bool) -> list[Checked]:
    """All of them, if each can be started and no two are the same. Raises ConfigError.

    What differs in its seed alone is read once.
    """
    by_values: dict[str, Checked] = {}
    by_run: dict[str, Job] = {}
    checked = []
    for job in jobs:
        alike = by_values.get(repr(job.values))
        if alike is None:
            alike = by_values[repr(job.values)] = _checked(job, on_this_machine)
            run = repr((alike.config, dataclasses.replace(alike.options, run_dir=None)))
            if (other := by_run.setdefault(run, job)) is not job:
                raise ConfigError("values", [other.values, job.values], "are one and the same run; give each once")
        config = dataclasses.replace(alike.config, seed=job.seed)
        config.__dict__["layout"] = alike.config.layout  # the environment is made once
        validate(config)
        checked.append(Checked(as_planned(job, config, alike.options), config, alike.options))
    return checked


def read_job(job: Job) -> tuple[RunConfig, LaunchOptions]:
    """A run's words, which can be read. What they do not say is the preset's, whatever its folder has."""
    command = parser.parse(list(job.words))
    return command.config(), command.launch_options()


def as_planned(job: Job, config: RunConfig, options: LaunchOptions) -> Job:
    """A run that says its length and what it takes of a machine: one that goes on would have what it had."""
    planned = {
        "--total-steps": config.total_steps, "--actors": config.actors, "--threads": config.learner.threads,
        "--device": options.device, "--launcher": options.launcher,
    }  # fmt: skip
    said = set(map(flag, job.words))
    unsaid = [word for name, value in planned.items() if name not in said for word in (name, str(value))]
    return dataclasses.replace(job, words=(*job.words, *unsaid))


def _checked(job: Job, on_this_machine: bool) -> Checked:
    command = parser.parse(list(job.words))
    config, options = command.config(), dataclasses.replace(command.launch_options(), run_dir=job.folder)
    validate_launch(config, options)
    if on_this_machine:
        check_machine(config, options)
        choose_tracking(options)
    else:
        if options.device not in ("cpu", "cuda", "cuda:0"):
            raise ConfigError("--device", options.device, "a run on a node sees one GPU; take cuda")
        config.sizes()  # the environment's, which the nodes make, too
    if not options.goes_on:  # is_finished judges the others; a run whose folder has something else fails alone
        check_start(config, dataclasses.replace(options, run_dir=None))
    return Checked(job, config, options)


def is_integer(name: str, config: RunConfig) -> bool:
    """Whether an option's values are whole numbers. Raises ConfigError where they are no numbers."""
    (value,) = [value for path, value in flat(config).items() if path.rpartition(".")[2] == name] or [None]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"search.{name}", value, "only numbers have a range; give a list of choices")
    return isinstance(value, int)
