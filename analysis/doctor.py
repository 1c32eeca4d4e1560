"""``rmc doctor``: what holds a run back, by how much, and the option that changes it, from its own records."""

import math
from collections.abc import Callable, Sequence

from rmc.analysis import host_faults, run_faults
from rmc.analysis.bottleneck import bottleneck
from rmc.analysis.finding import Finding
from rmc.analysis.vitals import Record, Vitals
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.metrics_tail import MetricsTail
from rmc.deploy.run.state import remedy
from rmc.deploy.run.validation import validate

LEAST_SECONDS = 5.0  # of training; fewer say nothing
Diagnosis = Callable[[Vitals, RunConfig], Finding | None]
ALWAYS: tuple[Diagnosis, ...] = (run_faults.not_saved, run_faults.stalled, run_faults.long_warm_up)
IN_TRAINING: tuple[Diagnosis, ...] = (
    bottleneck,
    host_faults.threads_fight,
    host_faults.oversubscribed,
    host_faults.stolen,
    host_faults.little_memory,
    run_faults.diverging,
    run_faults.stale_weights,
    run_faults.oversized_ring,
)


def examine(records: Sequence[Record], config: RunConfig) -> list[Finding]:
    """All that is found, the gravest first; empty where too little was recorded to judge.

    Raises ConfigError for a config that makes no sense.
    """
    validate(config)
    vitals = Vitals(records)
    whole = Vitals(records, math.inf)  # for what is rare, has lasted for long, or is compared with before training
    away = run_faults.redis_away(vitals, config)  # then nothing else can be judged
    findings: list[Finding | None] = [away]
    if not away:
        findings = [*(diagnosis(vitals, config) for diagnosis in ALWAYS), run_faults.silent(whole, config)]
    training = vitals.training()
    if training.seconds >= LEAST_SECONDS and not any(findings):
        findings += [diagnosis(training, config) for diagnosis in IN_TRAINING]
        findings += [run_faults.evaluator_starved(whole, config), host_faults.slow_memory(whole, config)]
    return [finding for finding in findings if finding is not None]


def examine_run(folder: RunFolder) -> tuple[list[Finding], float]:
    """What is found in a run's newest records, and over how many seconds of training.

    Raises ConfigError where too little was recorded to judge.
    """
    config, records = folder.config(), MetricsTail(folder.metrics).take()
    findings, seconds = examine(records, config), Vitals(records).training().seconds
    if not findings and seconds < LEAST_SECONDS:
        fault = f"it has {seconds:.0f} s of training on record, the doctor needs {LEAST_SECONDS:.0f}"
        raise ConfigError("RUN", str(folder.path), f"{fault}; {remedy(folder)}")
    return findings, seconds
