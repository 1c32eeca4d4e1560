"""A plan whose values Optuna chooses from what earlier runs returned; hopeless ones are pruned by their evaluations.

The sweep's index is all that it remembers: a search that goes on is told again what became of its trials. Each trial
draws with a seed of its own, so that one that goes on draws what it would have drawn.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import TrialState

from rmc.analysis.history import Evaluation, of_run
from rmc.common.errors import ConfigError
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.metrics_tail import MetricsTail
from rmc.sweep.index import NAME, Index
from rmc.sweep.job import TRIAL, Job
from rmc.sweep.pool import Ending
from rmc.sweep.spec import Range, Search

STARTUP_TRIALS = 4  # that are finished before any is pruned
FIRST_JUDGED = 2  # evaluation of a trial
TRIAL_STATES = {"finished": TrialState.COMPLETE, "pruned": TrialState.PRUNED}


class SearchPlan:
    """One run a trial; maximises the return."""

    def __init__(
        self,
        search: Search,
        distributions: Mapping[str, BaseDistribution],
        index: Index,
        make: Callable[[str, dict[str, Any]], Job],
        is_finished: Callable[[Job], bool],
        checkpoint_steps: int,
    ) -> None:
        """``make`` gives a trial's run by its name and values.

        Raises ConfigError where the index has other ranges, or lacks a trial whose folder is there.
        """
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self._search, self._distributions, self._make = search, dict(distributions), make
        self._is_finished = is_finished
        self._checkpoint_steps = checkpoint_steps
        pruner = optuna.pruners.MedianPruner(STARTUP_TRIALS, FIRST_JUDGED)
        self._study = optuna.create_study(direction="maximize", pruner=pruner)
        self._at_work: dict[str, _Trial] = {}
        self.todo: list[Job] = []
        self._index = index
        self.jobs = [self._earlier_job(line) for name, line in index.lines.items() if name.startswith(TRIAL)]
        self._names = self._all_names()
        self._check_folders()

    def _check_folders(self) -> None:
        """Raises ConfigError where a trial's folder is there without its line: a new one would go on in it."""
        for name in (f"{TRIAL}{number}" for number in range(self._search.trials)):
            if name not in self._index.lines and (self._index.folder / name / "config.json").exists():
                fix = f"{NAME} has no line of it, so a new trial would go on in it; move it away"
                raise ConfigError("--sweep-dir", str(self._index.folder / name), fix)

    def _earlier_job(self, line: dict[str, Any]) -> Job:
        """Tell Optuna of a trial of before, or take it up again."""
        name, values = str(line["run"]), line["values"]
        job = self._make(name, values)
        is_finished = self._is_finished(job)  # raises for other options, whatever its state
        over = line["state"] == "pruned" or (line["state"] == "finished" and is_finished)
        try:
            trial = self._frozen(job, line, TRIAL_STATES[line["state"]] if over else TrialState.FAIL)
        except (KeyError, ValueError):
            fix = f"{name} has {values}, which these ranges do not hold; use those of before, or another --sweep-dir"
            raise ConfigError("search.ranges", sorted(self._distributions), fix) from None
        if over:
            self._study.add_trial(trial)
        else:
            self.todo.append(job)
        return job

    def _frozen(self, job: Job, line: dict[str, Any], state: TrialState) -> optuna.trial.FrozenTrial:
        """Raises KeyError, ValueError where its values are not of these ranges."""
        if line["values"].keys() != self._distributions.keys():
            raise KeyError
        judged = self._evaluations(job)
        if not judged and state == TrialState.COMPLETE:
            state = TrialState.FAIL
        return optuna.trial.create_trial(
            state=state,
            value=judged[-1][1].return_mean if state == TrialState.COMPLETE else None,
            params=self._params(line["values"]),
            distributions=self._distributions,
            intermediate_values={step: one.return_mean for step, one in judged},
        )

    def _params(self, values: dict[str, Any]) -> dict[str, Any]:
        """Values as Optuna has them."""
        choices = [name for name, kind in self._distributions.items() if isinstance(kind, CategoricalDistribution)]
        return values | {name: json.dumps(values[name]) for name in choices}

    def _values(self, params: dict[str, Any]) -> dict[str, Any]:
        """The reverse."""
        return {name: json.loads(value) if isinstance(value, str) else value for name, value in params.items()}

    def _all_names(self) -> Iterator[str]:
        """Of those that go on, then of new ones up to as many trials as there shall be."""
        yield from [job.name for job in self.todo]
        for number in range(self._search.trials):
            if f"{TRIAL}{number}" not in self._index.lines:
                yield f"{TRIAL}{number}"

    def next(self) -> Job | None:
        name = next(self._names, None)
        if name is None:
            return None
        line = self._index.lines.get(name)
        if line is not None:
            self._study.enqueue_trial(self._params(line["values"]))
        apart = np.random.SeedSequence([self._search.sampler_seed, int(name.removeprefix(TRIAL))])
        seed = int(apart.generate_state(1)[0])  # of neighbouring seeds no two draw alike
        self._study.sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=True)
        trial = self._study.ask(self._distributions)
        job = self._make(name, self._values(trial.params))
        self._at_work[name] = _Trial(trial, MetricsTail(RunFolder(job.folder).metrics))
        if line is None:
            self.jobs.append(job)
        return job

    def is_hopeless(self, job: Job) -> bool:
        """Whether its evaluations are below the median of the others' at as many steps."""
        if not self._search.prune:
            return False
        at_work = self._at_work[job.name]
        if not any("eval_return_mean" in record for record in at_work.tail.take()):
            return False
        self._report(at_work, job)
        return bool(at_work.trial.should_prune())

    def _report(self, at_work: "_Trial", job: Job) -> None:
        for step, one in self._evaluations(job):
            if step not in at_work.reported:
                at_work.reported.add(step)
                at_work.trial.report(one.return_mean, step)

    def _evaluations(self, job: Job) -> list[tuple[int, Evaluation]]:
        """By which evaluation of a run it is: the steps themselves differ a little from run to run."""
        try:
            evaluations = of_run(RunFolder(job.folder)).evaluations
        except ConfigError:  # none yet
            return []
        by_step = {round(one.env_steps / self._checkpoint_steps): one for one in evaluations}
        return sorted(by_step.items(), key=lambda pair: pair[0])

    def end(self, job: Job, ending: Ending) -> None:
        at_work = self._at_work.pop(job.name)
        self._report(at_work, job)
        judged = self._evaluations(job) if ending.state == "finished" else []
        if judged:
            self._study.tell(at_work.trial, judged[-1][1].return_mean)
        else:
            state = TrialState.PRUNED if ending.state == "pruned" else TrialState.FAIL
            self._study.tell(at_work.trial, state=state)


class _Trial:
    def __init__(self, trial: optuna.Trial, tail: MetricsTail) -> None:
        self.trial, self.tail = trial, tail
        self.reported: set[int] = set()


def distribution(values: Range | list[Any], whole: bool) -> BaseDistribution:
    """Optuna's for an option whose values are ``whole`` numbers or not; choices are text of JSON, as lists may be."""
    if isinstance(values, list):
        return CategoricalDistribution([json.dumps(value) for value in values])
    if whole:
        return IntDistribution(int(values.low), int(values.high), log=values.log)
    return FloatDistribution(float(values.low), float(values.high), log=values.log)
