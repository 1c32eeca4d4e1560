"""Runs a study: several agents, several seeds each, a line of results a run; the same command continues it.

    python -m studies.NAME [--scale smoke|small|full] [--env ENV ...] [--only AGENT ...] [--seeds 1 2 3] [--jobs 2]
    python -m studies.NAME --steps 300000 …
    python -m studies.NAME … --play

smoke takes minutes, small two cores and hours, full is for a cluster or a GPU; --steps is small, but of so many
environment steps, with files of its own (NAME-STEPS.jsonl). A run that has its line in
studies/results/NAME-SCALE.jsonl is not run again, one that was interrupted goes on in runs/studies/. Several jobs share
the cores, each on its own part of them. ``rmc plot studies/results/NAME-SCALE.jsonl`` shows what came. Some studies
play, with ``--play``, what the same command has trained.
"""

import argparse
import dataclasses
import json
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from rmc.analysis import history
from rmc.cli.signals import signals_caught
from rmc.common.errors import ConfigError
from rmc.deploy.run.folder import RunFolder
from rmc.sweep.grid import Grid
from rmc.sweep.job import Job
from rmc.sweep.local_runs import LocalRuns
from rmc.sweep.pool import Ending, conduct

RESULTS, RUNS = Path(__file__).parent / "results", Path("runs") / "studies"
TINY = "--checkpoint-steps 300 --episodes 1"  # at the scale smoke
TINY_OURS = f"{TINY} --hidden 16 --embedding 16 --heads 16 16 --warmup-steps 200 --batch-size 6 --replay-ratio 4"


def earlier(words: str = "") -> str:
    """Words of ``robust`` as it was with a target entropy of -A, and these."""
    return f"train ENV --target-entropy -1 {words}".rstrip()


def before(words: str = "") -> str:
    """Words of ``robust`` as it was before batch norm, and these: target critics, 8 windows, a replay ratio of 48, the
    policy at every update, heads that read h alone, a target entropy of -A.
    """
    sizes = {"--batch-size": "8", "--replay-ratio": "48", "--policy-delay": "1", "--head-input": "hidden"}
    unsaid = [f"{option} {value}" for option, value in sizes.items() if option not in words]
    return earlier(" ".join(["--no-critic-batch-norm", *unsaid, words]))


@dataclasses.dataclass(frozen=True)
class Scale:
    """How much of it."""

    steps: int
    seeds: Sequence[int]
    envs: Sequence[str] = ("HalfCheetah-v5",)


SMOKE, SMALL, FULL = Scale(1_200, (1,)), Scale(100_000, (1, 2)), Scale(1_000_000, (1, 2, 3, 4, 5))


@dataclasses.dataclass(frozen=True)
class Play:
    """What is done with finished runs: a line a run, in NAME-SCALE.KIND.jsonl, and how that file is told."""

    kind: str
    play: Callable[[Job], dict[str, Any]]
    report: Callable[[Path], None]


class Study:
    """Agents by their names in the results, each as words of ``rmc``.

    ENV is the environment there, ``RUN:AGENT`` the folder of another agent's run of the same environment and seed.
    """

    def __init__(self, name: str, agents: Mapping[str, str], small: Scale = SMALL, full: Scale = FULL) -> None:
        self.name, self.agents = name, {agent: shlex.split(words) for agent, words in agents.items()}
        self.scales = {"smoke": dataclasses.replace(SMOKE, envs=small.envs), "small": small, "full": full}

    def jobs(
        self,
        scale: str,
        seeds: Sequence[int] | None = None,
        envs: Sequence[str] | None = None,
        only: Sequence[str] | None = None,
    ) -> list[Job]:
        """All runs of a scale, seed by seed. Raises ConfigError where ``only`` names no agent of the study."""
        if unknown := set(only or ()) - set(self.agents):
            raise ConfigError("--only", sorted(unknown), f"use some of {', '.join(map(repr, self.agents))}")
        size = self.scales[scale]
        agents = [agent for agent in self.agents if only is None or agent in only]
        return [self._job(scale, *one) for one in product(seeds or size.seeds, envs or size.envs, agents)]

    def _job(self, scale: str, seed: int, env: str, agent: str) -> Job:
        own = {"ENV": env} | {f"RUN:{one}": str(self._folder(scale, seed, env, one)) for one in self.agents}
        words = [own.get(word, word) for word in self.agents[agent]]
        tiny = {"train": TINY_OURS, "baseline": TINY}[words[0]].split() if scale == "smoke" else []
        size = ["--total-steps", str(self.scales[scale].steps), "--seed", str(seed)]
        words = [*words[:2], *tiny, *words[2:], *size]  # what the study says of it wins
        return Job(self._folder(scale, seed, env, agent), tuple(words), seed, {"agent": agent, "env": env})

    def _folder(self, scale: str, seed: int, env: str, agent: str) -> Path:
        plain = "".join(letter if letter.isalnum() else "-" for letter in f"{env} {agent} {seed}")
        return RUNS / f"{self.name}-{scale}" / plain

    def of_steps(self, steps: int) -> str:
        """The name of a scale that is small, but of so many environment steps."""
        self.scales[str(steps)] = dataclasses.replace(self.scales["small"], steps=steps)
        return str(steps)

    def results(self, scale: str) -> Path:
        """The file of a scale's lines; a smoke test's are no results."""
        return (RUNS if scale == "smoke" else RESULTS) / f"{self.name}-{scale}.jsonl"

    def main(self, after: Play | None = None) -> None:
        """The command line; ``after`` is what ``--play`` does."""
        parser = argparse.ArgumentParser(description=f"The study {self.name}: {', '.join(self.agents)}.")
        length = parser.add_mutually_exclusive_group()
        length.add_argument("--scale", choices=list(self.scales), default="small")
        length.add_argument("--steps", type=int, help="as small, but of so many environment steps")
        parser.add_argument("--seeds", type=int, nargs="+")
        parser.add_argument("--env", nargs="+")
        parser.add_argument("--only", nargs="+", help="agents")
        parser.add_argument("--jobs", type=int, default=1, help="runs at once")
        if after is not None:
            parser.add_argument("--play", action="store_true", help="play what was trained")
        options = parser.parse_args()
        if options.jobs < 1:
            parser.error(f"--jobs={options.jobs}: take at least 1")
        scale = options.scale if options.steps is None else self.of_steps(options.steps)
        try:
            jobs = self.jobs(scale, options.seeds, options.env, options.only)
            if after is not None and options.play:
                after.report(self.played(scale, jobs, after))
            else:
                self.run(scale, jobs, options.jobs)
        except ConfigError as error:
            sys.exit(f"studies.{self.name}: {error}")
        except KeyboardInterrupt:
            sys.exit(f"studies.{self.name}: interrupted; the same command continues it")

    def played(self, scale: str, jobs: Sequence[Job], after: Play) -> Path:
        """The file of its lines, one for each finished run; plays those that it lacks. Raises ConfigError."""
        target = self.results(scale).with_suffix(f".{after.kind}.jsonl")
        lines = history.objects(target, "agent", "env", "seed").values() if target.exists() else []
        done = {(line["agent"], line["env"], line["seed"]) for line in lines}
        for job in jobs:
            if _key(job) not in done and RunFolder(job.folder).result():
                line = json.dumps(after.play(job))
                with target.open("a") as file:
                    file.write(line + "\n")
        if not target.exists():
            raise ConfigError("--play", str(target), "no such run has ended; the same command without it trains them")
        return target

    def run(self, scale: str, jobs: Sequence[Job], at_once: int = 1) -> None:
        """Those that have no line yet, so many at once. Raises ConfigError for the first that fails, after the rest."""
        target = self.results(scale)
        target.parent.mkdir(parents=True, exist_ok=True)
        histories = history.read_histories(target) if target.exists() else []
        done = {(one.agent, one.env.partition(",")[0], one.seed) for one in histories}
        commits: dict[str, str] = {}  # of the code that each began with, by its name
        failures: list[ConfigError] = []

        def begun(job: Job) -> None:
            print(f"{job.folder}: rmc {shlex.join(job.words)}", flush=True)
            commits[job.name] = commit()

        def ended(job: Job, ending: Ending) -> None:
            if ending.state == "finished":
                with target.open("a") as file:
                    file.write(_line(job, commits[job.name]) + "\n")
            else:
                reason = f"{ending.state}: {ending.reason}"
                failures.append(ConfigError(job.values["agent"], shlex.join(job.words), reason))

        with signals_caught() as stop:
            conduct(Grid(job for job in jobs if _key(job) not in done), LocalRuns(at_once), stop, begun, ended)
        if stop.requested:
            raise KeyboardInterrupt
        if failures:
            raise failures[0]


def _key(job: Job) -> tuple[str, str, int]:
    return job.values["agent"], job.values["env"], job.seed


def _line(job: Job, commit: str) -> str:
    """A finished run's, under the name that the study has for it."""
    (past,) = history.read_histories(job.folder)
    return dataclasses.replace(past, agent=job.values["agent"], commit=commit).to_line()


def commit(studies: Path = RESULTS.parent) -> str:
    """Of the code that runs; with a + where it has changed since. Results are no code; "" outside a repository."""

    def git(*words: str) -> str:
        process = subprocess.run(["git", "-C", str(studies), *words], capture_output=True, text=True, check=False)
        return process.stdout.strip()

    changed = git("diff", "--name-only", "HEAD", "--", ":(top)", f":(exclude){RESULTS.name}")
    return git("rev-parse", "--short=7", "HEAD") + "+" * bool(changed)
