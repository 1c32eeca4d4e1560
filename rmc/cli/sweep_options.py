"""``rmc sweep`` as a dataclass."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional


@dataclass(frozen=True)
class Sweep:
    """Train many runs: environments and a grid's values with each seed, or a search; the same command continues it.

    Options for every run follow ENV or SPEC, as in rmc train.
    """

    what: Annotated[Positional[str], tyro.conf.arg(metavar="ENV|SPEC.toml")]
    """ENV as in rmc train, or ENV,ENV for several, or a file with env, seeds, [options], and [grid] or [search]."""
    seeds: str | None = None
    """Seeds of each value of the grid, like 1-5 or 1,4,7; by default 0."""
    grid: tuple[str, ...] = ()
    """Options of rmc train and their values, like learning_rate=3e-4,1e-3 'heads=[64,64],[256,256]'."""
    search: tuple[str, ...] = ()
    """In place of a grid: options to search, like learning_rate=1e-5..1e-2:log n_step=1..5 (extra: optuna)."""
    trials: int = 20
    """Runs of a search, over all its starts."""
    sampler_seed: int = 0
    """Seed of what a search draws."""
    prune: bool = True
    """Stop a search's runs whose evaluations are below the median of the others'."""
    sweep_dir: Path | None = None
    """The sweep's folder; by default runs/<SPEC's name>, or runs/<first env>__sweep."""
    jobs: int = 0
    """Runs at once; 0 for as many as cores and memory hold, or one where the device is cuda."""
    drop_replay: bool = False
    """Remove the replay ring of a run that is finished or pruned: evaluate, plot and export need none."""
    launcher: Literal["local", "lockstep", "ray"] = "local"
    """Runs on this machine, or each in lockstep there, or whole runs spread over a Ray cluster."""
    ray_address: str = "auto"
    """With --launcher ray: auto finds the cluster that this machine is in, local starts one on this machine."""
    train_words: tyro.conf.Suppress[tuple[str, ...]] = ()
    """Options of rmc train, as they were typed."""
