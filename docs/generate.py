"""Writes docs/configuration.md from the options' dataclasses: ``make docs``. A test asks whether it is up to date."""

import dataclasses
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from docstring_parser import parse_from_object

from rmc.analysis.report import words
from rmc.cli.train_options import Train
from rmc.common.env.config import RANGES as ENV_RANGES
from rmc.common.env.config import EnvConfig
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.option_names import option
from rmc.deploy.run.presets import paper, robust
from rmc.deploy.run.validation import RANGES

PAGE = Path(__file__).parent / "configuration.md"
TITLES = {
    "run": "The run",
    "env": "The environment, as the agent sees it",
    "window": "Windows",
    "agent": "Networks",
    "actor": "Actors",
    "replay": "Replay",
    "update": "The update",
    "learner": "The learner",
    "evaluator": "Evaluation",
}
HEAD, RULE = "| option | takes | default | what it is | when to touch it |", "|---|---|---|---|---|"
ENDLESS = 1e9  # an upper limit from which on nobody meets it
PLACEMENT = [
    "run_dir", "if_exists", "launcher", "device", "redis_url", "ray_address", "all_cpus", "tls", "metrics_port",
    "metrics_host", "dry_run",
]  # fmt: skip
TRACKING = ["video_every", "track", "track_project", "track_tags"]
BEGINNING = ["init_from", "init_parts"]
# When a user should touch an option; what it does is said where it is defined.
WHEN = {
    "preset": "`memory` where a cue is needed long after, `paper` to compare with the paper, `debug` to see everything "
    "run within a minute",
    "seed": "for every repetition",
    "total_steps": "always: it is the length of the run, and also where a finished one goes on to",
    "actors": "when the learner waits for experience; on two cores one actor is enough",
    "run_dir": "to name a run, and to continue one",
    "if_exists": "`fail` or `new` where a script must not continue an old run by chance",
    "init_from": "to begin with what another run has [learnt](warm-start.md); for a new run alone",
    "init_parts": "`memory+world-model` for another reward, `policy` to begin with what acts",
    "launcher": "`ray` for several machines, `lockstep` for the same bits again, `manual` to start the roles yourself",
    "device": "`cuda` where there is a GPU: see [On a GPU](gpu.md)",
    "redis_url": "with `--launcher manual`, or to keep a run in a Redis of yours",
    "ray_address": "`local` to try Ray on one machine",
    "all_cpus": "on a cluster that is there for this run",
    "tls": "where others are on the cluster's network",
    "track": "to compare runs in a web service, or to keep their videos",
    "track_project": "to keep kinds of runs apart",
    "track_tags": "to find runs again",
    "video_every": "to see how the policy changes; each film takes a core for some seconds, at low priority",
    "metrics_port": "to watch runs with [Prometheus and Grafana](watching.md#prometheus-and-grafana)",
    "metrics_host": "where Prometheus runs on another machine, or outside of the container",
    "dry_run": "before a long run, or on a machine that is new to it",
    "flicker": "for trials of partial observation",
    "drop_sensors": "for trials of sensors that fail one by one, see [missing sensors](missing-sensors.md)",
    "flicker_burst": "for failures that last; with `--flicker` or `--drop-sensors`",
    "delay": "for trials of sensors that are late",
    "hide": "for trials of partial observation",
    "noise": "for trials of partial observation",
    "frame_stack": "to compare a memory with a stack; 1 with a memory",
    "action_repeat": "where a single step changes almost nothing",
    "time_limit": "where episodes do not end, or the end comes too late to learn from",
    "env_kwargs": "where its `__init__` takes keywords, or must be given some",
    "env_timeout": "up for an environment whose steps or resets take long",
    "burn_in": "up where stored states are stale: `stale_state_burned` is large",
    "trained_steps": "up where something older must be learnt of; an update takes as much longer",
    "hidden": "up for large observations, down for speed",
    "embedding": "0 for the paper's raw input",
    "heads": "rarely",
    "gate_init": "`chrono` where something seen once is needed many steps later; the preset `memory` has it",
    "head_input": "`hidden` where the memory must do alone; `observation`, with "
    "`--scheme 2 --no-grounding --hidden 8 --embedding 0`, where all is seen and time counts: "
    "[far behind the other two by 300 000 steps](results.md)",
    "critic_batch_norm": "off for target critics, and with batches below 16: [what it is worth](results.md)",
    "privileged_critic": "where the simulator knows what sensors do not see: "
    "[an environment of your own](custom-environments.md#seen-in-part)",
    "normalize_observations": "off, with `--no-impute-missing`, where they are scaled and their statistics keep moving",
    "grounding": "off for the paper's model, with `--scheme 1`; with scheme 3 it keeps the memory from collapsing",
    "impute_missing": "rarely: without it missing frames cost far more return, see [results](results.md)",
    "missing_flag": "with flicker, to see what the flag is worth; the paper has none",
    "initial_priority": "`actor` where new windows should not all be drawn soon; it costs the actors a forward pass",
    "envs_per_actor": "up where actors are the bottleneck: they share one forward pass",
    "stride": "down for overlapping windows, which train a step more than once (an episode's last ones less often)",
    "state_strategy": "`episode` where anything since the start may count; the others to compare with the paper",
    "reward_scale": "where a step's rewards are in the hundreds, as in HumanoidStandup, or all below 0.001",
    "refresh_steps": "rarely: how far actors lag behind is in the metrics",
    "chunk_windows": "up on a slow network",
    "chunk_seconds": "rarely",
    "unacked_bytes": "down where actors have little memory",
    "capacity": "down for a small disk or memory: a window takes 3.7 kB for HalfCheetah, 41 kB for Humanoid",
    "replay_ratio": "up for more learning from each step (240 is an update a step), down for more steps a second",
    "warmup_steps": "up where random actions rarely meet a reward",
    "priority_exponent": "0.6 for R2D2's prioritized replay, 0 for uniform",
    "importance_exponent": "rarely: uniform replay, as in `robust`, has no use for it",
    "replay_shards": "up where one replay server is the bottleneck: with dozens of actors, `--actors` a multiple of it",
    "learning_rate": "down when the losses jump or training diverges",
    "memory_learning_scale": "down to keep stored states fresh, at the price of a slower memory",
    "alpha_learning_rate": "up where exploration stays high for too long",
    "target_entropy": "up where a policy gets stuck in what it found first; down, to SAC's -1, for a calmer one",
    "gamma": "up for goals further away than 100 steps, down for nearer ones",
    "polyak": "up for slower, steadier targets; of use with `--no-critic-batch-norm`, or an `ema` memory",
    "clip_norm": "where single batches throw training off (`grad_norm` in the metrics); "
    "40 cost return in a trial (`studies/notebook.md`)",
    "scheme": "to repeat the paper's table 1, where 1 is best; in our "
    "[results](results.md) 3 is ahead on Walker2d and with half of the frames missing, level on HalfCheetah",
    "policy_through_q": "with schemes 4 to 6",
    "update_order": "`alternate` for algorithm 1 as printed, at up to five times the forwards "
    "(four with `--no-impute-missing`)",
    "model_norm": "to repeat the paper's comparison",
    "policy_delay": "1 for more return from each step, up for more updates a second: [results](results.md)",
    "n_step": "up where rewards are rare; it is biased by old data",
    "latent_target": "`ema` where the latent rank in the metrics falls; it cost return (`studies/notebook.md`)",
    "target_memory": "`ema` for slower targets; it cost return in a trial (`studies/notebook.md`)",
    "policy_q": "`first` for the paper",
    "curiosity": "up where rewards are rare, as 50 where a goal alone pays; 0 where observations flicker for long",
    "curiosity_scale": "`std` makes beta mean the same in every environment, `raw` is the paper's",
    "curiosity_steps": "as long as exploration should last",
    "policy_ema_updates": "0 to evaluate and save what acts; up where evaluations swing",
    "eta": "rarely; only with prioritized replay",
    "batch_size": "up for steadier updates, and on a GPU; below 16 take `--no-critic-batch-norm`, too",
    "publish_updates": "rarely",
    "checkpoint_steps": "down to see more evaluations",
    "keep_checkpoints": "up to go back further; the best is always kept",
    "precision": "`fp32` to avoid rounding; an update then runs at 0.37 to 0.56 of the speed on a CPU with bfloat16",
    "threads": "1 to leave a core to other runs; more where cores are free. On Ray and in lockstep 0 is 1. In lockstep "
    "and on a GPU there is one process",
    "evaluation_seconds": "up where an episode takes minutes: if none has ended, the first one's return so far counts",
    "episodes": "up for less noise in what is called the best checkpoint; 0 where one environment alone can exist",
}


def main() -> None:
    """Write the page."""
    PAGE.write_text(page())


def page() -> str:
    """The whole page as Markdown."""
    lines = [
        "# Every option of `rmc train`",
        "",
        "Written by `make docs` from the code. Defaults are `robust`'s; what `paper` has otherwise is in brackets.\n"
        "Beside these, `--config FILE.toml` takes [options from a file](command-line.md#options-from-a-file).",
    ]
    defaults, paper_config = robust(EnvConfig("")), paper(EnvConfig(""))
    for part, title in TITLES.items():
        lines += ["", f"## {title}", "", HEAD, RULE]
        configs = (defaults, paper_config) if part == "run" else (getattr(defaults, part), getattr(paper_config, part))
        lines += _rows(*configs, f"{part}." * (part != "run"))
        if part == "run":
            lines += ["", "Which of them may change when a run goes on: [Resume a run](resume.md#what-may-change)."]
            lines += ["", "## Where it runs", "", HEAD, RULE, *_launch_rows(PLACEMENT)]
            lines += ["", "## Trackers", "", HEAD, RULE, *_launch_rows(TRACKING)]
            lines += ["", "## What a new run begins with", "", HEAD, RULE, *_launch_rows(BEGINNING)]
    return "\n".join(lines) + "\n"


def _rows(defaults: Any, paper_config: Any, section: str) -> list[str]:
    """Of a part's options; ``section`` is what comes before their names in RANGES."""
    help_texts, hints = _docstrings(type(defaults)), get_type_hints(type(defaults))
    limits = RANGES | {f"env.{name}": ends for name, ends in ENV_RANGES.items()}
    rows = []
    for item in dataclasses.fields(defaults):
        value, other = getattr(defaults, item.name), getattr(paper_config, item.name)
        if dataclasses.is_dataclass(value) or item.name == "id":
            continue
        default = words(value) if value == other or item.name == "preset" else f"{words(value)} ({words(other)})"
        takes = _takes(hints[item.name], limits.get(section + item.name))
        rows.append(f"| `{option(item.name)}` | {takes} | {default} | {help_texts[item.name]} | {WHEN[item.name]} |")
    return rows


def _launch_rows(names: list[str]) -> list[str]:
    help_texts = _docstrings(LaunchOptions) | _docstrings(Train)
    defaults = {item.name: item.default for item in dataclasses.fields(Train)}
    takes = {name: _takes(hint, None) for name, hint in get_type_hints(Train).items()}
    cells = {name: (takes[name], words(defaults[name]), help_texts[name], WHEN[name]) for name in names}
    return [f"| `{option(name)}` | {' | '.join(texts)} |" for name, texts in cells.items()]


def _takes(hint: Any, limits: tuple[float, float] | None) -> str:
    """The values of a type, or the least and the most; empty where a text is taken."""
    if limits is not None:
        low, high = (words(int(limit) if limit == int(limit) else limit) for limit in limits)
        return f"{low} to {high}" if limits[1] < ENDLESS else f"at least {low}"
    if hint is bool:
        return "on, off"
    of_union = [_takes(one, None) for one in get_args(hint) if get_origin(hint) in (Union, UnionType)]
    choices = get_args(hint) if get_origin(hint) is Literal else filter(None, of_union)
    return ", ".join(map(str, choices))


def _docstrings(kind: type[Any]) -> dict[str, str]:
    """What stands under each field in the source, which the help shows, too."""
    return {text.arg_name: text.description or "" for text in parse_from_object(kind).params}


if __name__ == "__main__":
    main()
