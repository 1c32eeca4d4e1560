"""What is wrong with a run beside its speed: pure functions of its records, one a fault."""

from itertools import pairwise

from rmc.analysis.finding import Finding, typed_number
from rmc.analysis.vitals import Vitals
from rmc.deploy.monitor.notices import STALLED_SECONDS
from rmc.deploy.run.config import RunConfig

SILENT_SECONDS = 30.0  # without a word; roles speak every second
PLAYED = 0.75  # of the checkpoints: fewer evaluations leave holes in the curve
STALE_UPDATES = 1_000  # of lag; docs/metrics.md calls tens to hundreds healthy
HALF_FULL, WORTH_WINDOWS = 0.5, 10_000  # of a ring, when a smaller one is worth a word
TOO_MUCH = 10.0  # times what critics can rightly expect: early on they hold an entropy that was worth more
WARM_UP_SECONDS = 300.0  # that are left of it


def redis_away(vitals: Vitals, _: RunConfig) -> Finding | None:
    """Nothing is heard of anybody while Redis does not answer; the launcher says for how long."""
    seconds = vitals.last("launcher", "redis_away_s")
    if seconds < STALLED_SECONDS / 2:
        return None
    return Finding("redis away", f"no answer for {seconds:.0f} s", "every role waits for it; look at its server")


def not_saved(vitals: Vitals, _: RunConfig) -> Finding | None:
    """All is trained, and the last checkpoint finds no room: a stop would lose what came after the one before."""
    if vitals.last("learner", "finished") or vitals.waiting_for("learner") != "disk":
        return None
    measured = f"the learner has waited {vitals.last('learner', 'waiting_s'):.0f} s to write its last checkpoint"
    return Finding("not saved", measured, "make room on the disk; do not stop the run")


def stalled(vitals: Vitals, config: RunConfig) -> Finding | None:
    """Deadlock: every role speaks, none gets on. A run that has finished is none."""
    if vitals.last("learner", "finished") or not_saved(vitals, config):
        return None
    still = _still_seconds(vitals)
    if still < STALLED_SECONDS:
        return None
    waits = [f"{role} for {reason}" for role in vitals.roles if (reason := vitals.waiting_for(role))]
    measured = f"no step and no update for {still:.0f} s ({', '.join(waits) or 'nobody says what it waits for'})"
    return Finding("deadlock", measured, "rmc stop saves the run and rmc resume continues it; logs/ may say why")


def _still_seconds(vitals: Vitals) -> float:
    """Since when no counter has moved."""
    moved = []
    for role, name in [("learner", "updates"), *((role, "env_steps") for role in vitals.of("replay"))]:
        series = vitals.series(role, name)
        changes = [now[0] for before, now in pairwise(series) if now[1] != before[1]]
        moved += changes[-1:] or [time for time, _ in series[:1]]
    return vitals.end - max(moved, default=vitals.end)


def silent(vitals: Vitals, _: RunConfig) -> Finding | None:
    """Roles that have stopped speaking while others go on."""
    ended = {role: vitals.end - vitals.series(role, "time")[-1][0] for role in vitals.roles if role != "launcher"}
    silences = [f"{role} for {seconds:.0f} s" for role, seconds in ended.items() if seconds > SILENT_SECONDS]
    if not silences or vitals.last("learner", "finished"):
        return None
    log = f"logs/{silences[0].split()[0]}.log"
    return Finding("silent", f"{', '.join(silences)} said nothing", f"it hangs, or its machine is away; see {log}")


def long_warm_up(vitals: Vitals, config: RunConfig) -> Finding | None:
    """No update yet, and none for long."""
    steps = sum(vitals.last(role, "env_steps") for role in vitals.of("replay"))
    rates = [vitals.last(role, "env_steps_per_s") for role in vitals.of("replay")]
    missing = config.replay.warmup_steps - steps
    if vitals.last("learner", "updates") > 0 or missing <= 0 or sum(rates) <= 0.0:
        return None
    seconds = missing / sum(rates)
    if seconds < WARM_UP_SECONDS:
        return None
    measured = (
        f"{steps:,.0f} of {config.replay.warmup_steps:,} steps at {sum(rates):,.0f} a second, {seconds:,.0f} s to go"
    )
    return Finding(
        "long warm-up",
        measured,
        f"--warmup-steps {config.replay.warmup_steps // 4} in a new run, or more --actors, would help",
    )


def evaluator_starved(vitals: Vitals, config: RunConfig) -> Finding | None:
    """Checkpoints come faster than the evaluator plays them; those in between are passed over."""
    if not config.evaluator.episodes:
        return None
    said = [value for _, value in vitals.series("learner", "checkpoint_update")]
    checkpoints = {value for value in said if value > 0} - set(said[:1])  # the first one an earlier start has played
    played = {value for _, value in vitals.series("evaluator", "eval_update")}
    missed = len(checkpoints - played)
    due = len(checkpoints) - 1  # the newest may be on its way
    if due <= 0 or len(checkpoints & played) >= PLAYED * due:
        return None
    every = typed_number(config.learner.checkpoint_steps * len(checkpoints) / max(1, len(checkpoints) - missed))
    fewer = max(1, config.evaluator.episodes * (len(checkpoints) - missed) // len(checkpoints))
    advice = f"--checkpoint-steps {every} gives it the time"
    if fewer < config.evaluator.episodes:
        advice += f", --episodes {fewer} or a smaller --evaluation-seconds makes it faster"
    return Finding("evaluator starved", f"{missed} of {len(checkpoints)} checkpoints were not evaluated", advice)


def stale_weights(vitals: Vitals, config: RunConfig) -> Finding | None:
    """Actors act with a policy that the learner has long left behind."""
    lag = vitals.mean("replay", "policy_lag_mean")
    if lag is None or lag < STALE_UPDATES:
        return None
    drawn, draws = (sum(vitals.last(role, name) for role in vitals.of("replay")) for name in ("drawn_steps", "draws"))
    trained = drawn / max(1.0, draws)
    refreshing = config.actor.refresh_steps * config.actors * config.replay.replay_ratio / max(1.0, trained) / 2
    name, now = "--refresh-steps", config.actor.refresh_steps
    if config.learner.publish_updates > refreshing:
        name, now = "--publish-updates", config.learner.publish_updates
    smaller = max(1, int(now * STALE_UPDATES / lag / 2))
    measured = f"windows came from a policy {lag:,.0f} updates old on average"
    return Finding("stale weights", measured, f"{name} {smaller} in place of {now} brings newer ones")


def diverging(vitals: Vitals, config: RunConfig) -> Finding | None:
    """Critics that expect more than the largest reward and entropy, for ever, would give."""
    reward, gamma = vitals.last("learner", "largest_reward"), config.update.gamma
    if not reward or gamma == 1.0 or config.update.curiosity:
        return None
    bonus = vitals.last("learner", "alpha") * abs(vitals.last("learner", "entropy"))
    most, expected = (reward + bonus) / (1.0 - gamma), vitals.last("learner", "q_mean")
    if abs(expected) <= TOO_MUCH * most:
        return None
    measured = f"they expect {expected:,.4g}; rewards of {reward:.3g} and the entropy's bonus make {most:,.4g} at most"
    return Finding("critics diverge", measured, "--learning-rate, a third of it, in a new run")


def oversized_ring(vitals: Vitals, config: RunConfig) -> Finding | None:
    """A ring that the whole run cannot fill."""
    steps, windows = (sum(vitals.last(role, name) for role in vitals.of("replay")) for name in ("env_steps", "windows"))
    fills, capacity = vitals.values("replay", "ring_fill"), config.replay.capacity
    if not steps or not fills or max(fills) >= HALF_FULL:
        return None
    end = max(*fills, windows / capacity) * config.total_steps / steps  # a ring that was lost holds fewer than came
    if end >= HALF_FULL or capacity * (1.0 - end) < WORTH_WINDOWS:
        return None
    needed = typed_number(1.1 * end * capacity)
    measured = f"of {capacity:,} windows {end:.0%} will be used at the end of the run"
    return Finding("ring never fills", measured, f"--capacity {needed} in a new run holds all of it")
