"""What can be read linearly out of h: a ridge regression in closed form, trained and tested on different episodes.

What is read is what the agent is not shown: hidden parts of the observation, and what ``info["probe"]`` says.
Shapes: N steps of several episodes, X numbers that are read from, Y numbers that are read.
"""

from dataclasses import dataclass
from math import isfinite
from statistics import fmean

import numpy as np
import torch
from numpy.typing import NDArray

from rmc.analysis.episodes import Episode, HiddenPart, unroll_episode
from rmc.common.agent import Agent, Memory
from rmc.common.window import BoolArray, Doubles

PENALTIES = (1e-4, 1e-2, 1.0)  # of the squared weights, as shares of the inputs' variance; one is chosen
QUARTERS = 4  # of the episodes: two to train on, one to choose the penalty by, one to test on
LEAST_SPREAD = 1e-6  # of what is read: what never changes says nothing


@dataclass(frozen=True)
class Probe:
    """R² on the test's episodes: 1 reads everything, 0 no more than the mean."""

    name: str
    from_memory: float
    from_untrained: float  # from a memory that never learnt: random features tell much, too
    from_newest: float  # from the newest observation that was seen, alone


@dataclass(frozen=True)
class Samples:
    """Rows of several episodes."""

    h: Doubles  # (N, H)
    untrained: Doubles  # (N, H)
    newest: Doubles  # (N, O), the newest observation that was seen, normalised
    own: Doubles  # (N, F), the environment's own observation
    probe: dict[str, Doubles]  # (N,)
    missing: BoolArray  # (N, M)
    quarter: NDArray[np.int64]  # (N,), the same for all steps of an episode


@torch.no_grad()
def samples(agent: Agent, untrained: Memory, episodes: list[Episode]) -> Samples:
    """All steps of all episodes, each with its last observation. Both memories read the same, filled by the agent."""
    h, started = [], []
    for episode in episodes:
        remembered, seen = unroll_episode(agent, episode)
        start = torch.zeros(1, agent.config.hidden)
        h.append(remembered.hidden[0].double().numpy())
        started.append(untrained(seen, episode.missing, episode.previous, start).hidden[0].double().numpy())
    return Samples(
        np.concatenate(h),
        np.concatenate(started),
        np.concatenate([_newest(episode) for episode in episodes]),
        np.concatenate([episode.own for episode in episodes]).astype(np.float64),
        {name: np.concatenate([episode.probe[name] for episode in episodes]) for name in episodes[0].probe},
        np.concatenate([episode.missing[0].numpy() for episode in episodes]),
        np.concatenate([np.full(len(states), index % QUARTERS) for index, states in enumerate(h)]),
    )


def _newest(episode: Episode) -> Doubles:
    """(T + 1, O), zeros until one is seen."""
    observation, missing = episode.observation[0], episode.missing[0]
    place = torch.where(missing, -1, torch.arange(len(missing)).unsqueeze(1)).cummax(0).values.expand_as(observation)
    newest: Doubles = torch.where(place < 0, 0.0, observation.gather(0, place.clamp(min=0))).double().numpy()
    return newest


def probes(agent: Agent, untrained: Memory, episodes: list[Episode], parts: list[HiddenPart]) -> list[Probe]:
    """Of each hidden part and of what the environment says; what never changes is left out."""
    rows = samples(agent, untrained, episodes)
    every = np.ones(len(rows.h), np.bool_)
    read = [
        _of_part(rows, part) if part.only_missing else _probe(part.name, rows, rows.own[:, part.columns], every)
        for part in parts
    ]
    read += [_probe(name, rows, values[:, None], every) for name, values in rows.probe.items()]
    return [probe for probe in read if probe is not None]


def _of_part(rows: Samples, part: HiddenPart) -> Probe | None:
    """Where it is missing; where its numbers are missing one by one, the mean of each one's own."""
    if rows.missing.shape[1] == 1:
        return _probe(part.name, rows, rows.own[:, part.columns], rows.missing[:, 0])
    each = [
        _probe(part.name, rows, y[:, None], at)
        for y, at in zip(rows.own[:, part.columns].T, rows.missing[:, part.flags].T, strict=True)
    ]
    found = [probe for probe in each if probe is not None]
    if not found:
        return None
    each_from = zip(*((one.from_memory, one.from_untrained, one.from_newest) for one in found), strict=True)
    return Probe(part.name, *map(fmean, each_from))


def _probe(name: str, rows: Samples, y: Doubles, at: BoolArray) -> Probe | None:
    """Of (N, Y) at some of the steps; None where there is nothing to train or test on."""
    at = at & np.isfinite(y).all(1)  # what the environment itself lacks is known to nobody
    quarter, y = rows.quarter[at], y[at]
    if len(set(quarter.tolist())) < QUARTERS:
        return None
    y = y[:, y[quarter < 2].std(0) > LEAST_SPREAD]
    if not y.size:
        return None
    found = [explained(x[at], y, quarter) for x in (rows.h, rows.untrained, rows.newest)]
    return Probe(name, *found) if isfinite(found[0]) else None


def explained(x: Doubles, y: Doubles, quarter: NDArray[np.int64]) -> float:
    """R² of (N, Y) read from (N, X), over the last quarter; each number of Y weighs the same."""
    trained, chosen, tested = quarter < 2, quarter == 2, quarter == 3
    x, y = ((each - each[trained].mean(0)) / np.maximum(each[trained].std(0), LEAST_SPREAD) for each in (x, y))
    weights = [_ridge(x[trained], y[trained], penalty) for penalty in PENALTIES]
    best = max(weights, key=lambda one: _r2(y[chosen], x[chosen] @ one))
    return _r2(y[tested], x[tested] @ best)


def _ridge(x: Doubles, y: Doubles, penalty: float) -> Doubles:
    """(X, Y) weights: (x'x / N + penalty)^-1 x'y / N."""
    return np.asarray(np.linalg.solve(x.T @ x / len(x) + penalty * np.eye(x.shape[1]), x.T @ y / len(x)), np.float64)


def _r2(y: Doubles, read: Doubles) -> float:
    """1 - squared error / squared distance from the mean; minus infinity where y does not change."""
    varied = ((y - y.mean(0)) ** 2).sum()
    return float(1.0 - ((y - read) ** 2).sum() / varied) if varied > 0.0 else -np.inf
