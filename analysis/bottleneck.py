"""Which stage holds a run back: pure functions of its records, one a stage."""

from math import ceil, floor

from rmc.analysis.finding import Finding
from rmc.analysis.vitals import Vitals
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.preflight import learner_threads

SATURATED = 0.8  # busy for more of the time is as busy as a stage gets
IDLE = 0.2  # waiting for more of the time is worth a word


def bottleneck(vitals: Vitals, config: RunConfig) -> Finding | None:
    """The one stage that the others wait for; None where the records do not say."""
    stages = (redis_bound, replay_bound, learner_bound, actor_bound, delivery_bound, balanced)
    return next((finding for stage in stages if (finding := stage(vitals, config)) is not None), None)


def redis_bound(vitals: Vitals, _: RunConfig) -> Finding | None:
    """Roles wait for Redis, which is away or full."""
    shares = {kind: vitals.waits(kind).get("redis", 0.0) for kind in ("actor", "learner", "replay")}
    kind = max(shares, key=lambda one: shares[one])
    if shares[kind] < IDLE:
        return None
    measured = f"the {kind} waited {shares[kind]:.0%} of the time for Redis, which is away or full"
    return Finding("redis-bound", measured, "look at the log of its server, or give another --redis-url")


def replay_bound(vitals: Vitals, config: RunConfig) -> Finding | None:
    """The replay server has no time left, and both sides wait for it."""
    busy, learner = vitals.busy("replay"), vitals.busy("learner")
    waits = vitals.waits("actor")
    slow = busy is not None and (busy >= SATURATED or waits.get("acknowledgements", 0.0) >= IDLE)
    if busy is None or learner is None or not slow or learner > 1.0 - IDLE or sum(waits.values()) < IDLE:
        return None
    shards = 2 * config.replay.replay_shards
    waiting = f"the learner waited {1 - learner:.0%} and actors {sum(waits.values()):.0%}"
    measured = f"the replay server was busy {busy:.0%} while {waiting}"
    more = f" with --actors {shards * ceil(config.actors / shards)}" if config.actors % shards else ""
    return Finding(
        "replay-bound",
        measured,
        f"--replay-shards {shards}{more} in a new run, or a larger --chunk-windows, would help",
    )


def learner_bound(vitals: Vitals, config: RunConfig) -> Finding | None:
    """The learner works all the time, and the actors wait for the credit that it gives them."""
    learner, actor = vitals.busy("learner"), vitals.busy("actor")
    waits = vitals.waits("actor").get("credit", 0.0)
    if learner is None or actor is None or learner < SATURATED or waits < IDLE:
        return None
    ratio = config.replay.replay_ratio / 2
    faster = min(2.0, 1.0 / max(actor, 0.01))
    measured = f"actors waited {waits:.0%} of the time for credit, the learner was busy {learner:.0%}"
    advice = (
        f"more actors will not help; a GPU (--device cuda) or a faster one, or --replay-ratio {ratio:g}, would: "
        f"the latter takes half the updates for each step, {faster:.1f} times the steps a second"
    )
    return Finding("learner-bound", measured, advice)


def actor_bound(vitals: Vitals, config: RunConfig) -> Finding | None:
    """The learner waits for experience that the actors cannot step fast enough."""
    learner, actor = vitals.busy("learner"), vitals.busy("actor")
    waits = vitals.waits("learner").get("experience", 0.0)
    if learner is None or actor is None or waits < IDLE or actor < 0.5:
        return None
    measured = f"the learner waited {waits:.0%} of the time for experience, actors were busy {actor:.0%}"
    return Finding("actor-bound", measured, _faster_actors(vitals, config, learner))


def _faster_actors(vitals: Vitals, config: RunConfig, learner: float) -> str:
    """As many actors as would keep the learner busy, where there are cores for them."""
    actors = ceil(config.actors / max(learner, 0.01))
    ratio = f"--replay-ratio {config.replay.replay_ratio / max(learner, 0.01):.3g} would use the learner's idle time"
    shards, free = config.replay.replay_shards, free_cores(vitals)
    if free is None:
        return f"more --actors would help where cores are free; with what there is, {ratio}"
    if free < 1.0:
        return f"all cores are taken: more machines (--launcher ray) would help, and {ratio}"
    affordable = min(actors, config.actors + floor(free)) // shards * shards
    return f"--actors {max(affordable, config.actors + shards)} would help; with what there is, {ratio}"


def delivery_bound(vitals: Vitals, config: RunConfig) -> Finding | None:
    """Both wait: what actors have stepped is not yet with the learner."""
    learner, actor = vitals.waits("learner").get("experience", 0.0), vitals.waits("actor").get("credit", 0.0)
    if learner < IDLE or actor < IDLE:
        return None
    measured = f"the learner waited {learner:.0%} for experience while actors waited {actor:.0%} for credit"
    advice = (
        f"windows are on their way; --envs-per-actor {2 * config.actor.envs_per_actor} lets actors run further ahead"
    )
    return Finding("delivery-bound", measured, advice)


def balanced(vitals: Vitals, _: RunConfig) -> Finding | None:
    """Nobody waits long."""
    learner, actor = vitals.busy("learner"), vitals.busy("actor")
    if learner is None or actor is None:
        return None
    measured = f"the learner was busy {learner:.0%}, actors {actor:.0%}"
    return Finding("balanced", measured, "no stage holds the others back; a faster machine, or more, would help")


def busy_threads(vitals: Vitals, config: RunConfig, cores: int) -> float:
    """Threads of the run that compute at the same time, on average."""
    learner = vitals.busy("learner") or 0.0
    others = [vitals.busy(kind) or 0.0 for kind in ("actor", "replay", "evaluator")]
    counts = [len(vitals.of(kind)) for kind in ("actor", "replay", "evaluator")]
    threads = threads_of_learner(vitals, config, cores)
    return learner * threads + sum(n * busy for n, busy in zip(counts, others, strict=True))


def threads_of_learner(vitals: Vitals, config: RunConfig, cores: int) -> int:
    """What it has chosen, or begins with."""
    return int(vitals.last("learner", "threads")) or learner_threads(config, cores)


def host_cores(vitals: Vitals) -> int:
    """Cores that the run may use; 0 where it was recorded without."""
    return max(0, int(vitals.last("launcher", "host_cores")))


def free_cores(vitals: Vitals) -> float | None:
    """Cores that nobody computes on, on average; a role that is busy need not compute: its environment may wait.

    None where that was not recorded, or the run has a part of its machine: how idle that is, nobody measures.
    """
    idle, cores = vitals.mean("launcher", "host_idle_share"), host_cores(vitals)
    if idle is None or cores < vitals.last("launcher", "host_cpus"):
        return None
    return idle * cores
