"""Which fault begins when, of which role or file, for how long: from a seed alone, so that it can be had again."""

import random
from collections.abc import Iterator
from dataclasses import dataclass

ACTORS = 3
EACH_ACTOR = tuple(f"actor-{actor}" for actor in range(ACTORS))
REDIS, LAUNCHER, NODE, LEARNER, REPLAY = "redis", "launcher", "node", "learner", "replay"
ROLES = (*EACH_ACTOR, LEARNER, REPLAY, "evaluator", "fork server")
WEATHERS = ("late", "hangs", "bytes", "cut")


@dataclass(frozen=True)
class Fault:
    """One of them."""

    at: float  # seconds from when the faults begin
    kind: str  # a key of ``KINDS``
    target: str
    seconds: float  # it lasts, or whoever was killed stays away
    chance: float  # 0 to 1, for what is left to chance: which byte of a file, say


@dataclass(frozen=True)
class Kind:
    """How often it is chosen beside others, what it may hit, how long it lasts."""

    weight: float
    targets: tuple[str, ...]
    longest: float = 0.0


KINDS = {
    "kill": Kind(60.0, (*EACH_ACTOR * 6, *[REPLAY] * 4, LEARNER, "evaluator", "fork server")),
    "kill redis": Kind(5.0, ("comes back", "comes back empty"), 3.0),
    "kill launcher": Kind(1.0, (LAUNCHER,), 2.0),
    "kill node": Kind(0.5, (NODE,), 3.0),
    "freeze": Kind(10.0, (*ROLES, REDIS, LAUNCHER), 12.0),
    "redis proxy": Kind(8.0, WEATHERS, 6.0),
    "replay proxy": Kind(8.0, WEATHERS, 6.0),
    "disk full": Kind(4.0, ("run", "log"), 8.0),
    "damage": Kind(4.0, ("checkpoint", "rows", "rows", "metrics.jsonl")),
}


def schedule(seed: int, gap: float) -> Iterator[Fault]:
    """Without end, on average every ``gap`` seconds, whatever goes on already."""
    chance, at = random.Random(seed), 0.0
    while True:
        at += chance.expovariate(1.0 / gap)
        (name,) = chance.choices(list(KINDS), [kind.weight for kind in KINDS.values()])
        kind = KINDS[name]
        target, seconds = chance.choice(kind.targets), chance.uniform(0.1 * kind.longest, kind.longest)
        yield Fault(round(at, 3), name, target, round(seconds, 3), round(chance.random(), 9))
