"""The newest state of a run: what its roles said last, its evaluations, how fast it goes and when it ends."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import mean
from typing import Any

from rmc.common.bus.metrics_record import is_complete, is_finite
from rmc.deploy.monitor.pace import Pace
from rmc.deploy.run.state import State

MOST_NAMES = 1000
LARGEST_STEP = 2**63 - 1  # that TensorBoard takes
SILENT_SECONDS = 5.0  # after which a role's silence is shown; it speaks every second
LAUNCHER_SECONDS = 15.0  # the same of the launcher, which speaks every 5
WAITING_SHARE = 0.5  # from which a role is said to wait
PAUSE_SECONDS = 30.0  # of the learner, after which what it waited before counts no more
MOST_CHECKPOINTS = 64  # whose steps are known: evaluations follow within a few
UNHEARD_SECONDS = 30.0  # of a role that has not spoken yet: it imports, and makes its environments


@dataclass(frozen=True)
class EvaluationStatus:
    """Deterministic episodes of one checkpoint; None is what the record did not say.

    One that is not complete, as an episode was cut or broken, is shown, and compared with no other.
    """

    return_mean: float
    return_std: float | None
    update: int | None
    env_steps: int | None
    is_complete: bool


class RunStatus:
    """The newest value of everything, by role."""

    def __init__(
        self, env: str, preset: str, seed: int, total_steps: int, replay_ratio: float, expected: tuple[str, ...] = ()
    ) -> None:
        """``expected`` are the roles that are about to speak."""
        self._since = dict.fromkeys(expected, time.time())  # of those that have not spoken
        self.began = 0.0  # the newest start, by the clock; 0 where that is not known
        self.steps_before = 0  # agent steps that the run had then, until its roles say more
        self._spoke_last, self._is_trained = 0.0, False  # anybody, and whether the learner's last word was its end
        self.state: State | None = "training"  # None where it has ended, and how is not known
        self.env, self.preset, self.seed, self.total_steps = env, preset, seed, total_steps
        self.replay_ratio = replay_ratio
        self.roles: dict[str, dict[str, Any]] = {}
        self.last: EvaluationStatus | None = None
        self.best: EvaluationStatus | None = None
        self.final_steps: int | None = None  # once the run has its result
        self.is_past = False  # whether newer words are there, and not taken in yet
        self.heard = "*"  # which roles speak all the time; of a baseline the launcher alone, of a copy none
        self._pace = Pace()
        self._checkpoints: dict[int, int] = {}  # agent steps by update
        self._counted, self._moved_at, self._spoke_at = (0, 0), 0.0, 0.0  # steps and updates, when they last grew

    @property
    def _began(self) -> float:
        """The newest start; one that lies ahead is not known, as the clock was set back."""
        return self.began if self.began <= time.time() else 0.0

    @property
    def is_over(self) -> bool:
        """Then nobody is expected to speak."""
        return self.state != "training"

    def take(self, record: dict[str, Any]) -> None:
        """Take in a record; what it does not name stays as it was.

        Of a role there are ``MOST_NAMES`` at most, but for the launcher, which names each role.
        """
        role = record["role"]
        current = self.roles.get(role, {})
        if role == "launcher" and _number(record.get("start_s")) < _number(current.get("start_s")):
            self._pace.forget()  # of another start
            self._is_trained = False
        fits = role == "launcher" or len(record) <= MOST_NAMES - len(current)
        new = record if fits else {name: record[name] for name in record if name in current}
        if role in self.roles:
            self.roles[role] = current | new
        else:  # afresh: another thread may be going through the old one
            self.roles = {**self.roles, role: dict(new)}
        self._note_word(record)
        self._note_checkpoint(record)
        self.take_evaluation(record)
        self._note_movement(_number(self.get("learner", "time")))
        trains = role.startswith("replay") and _number(self.get("learner", "updates_per_s")) > 0
        if "env_steps" in record and (trains or (self.heard == "launcher" and role == "learner")):  # a baseline's
            self._pace.note(_number(record.get("time")), self.env_steps)

    def _note_word(self, record: dict[str, Any]) -> None:
        spoke = _number(record.get("time"))
        if self._spoke_last < self._began <= spoke:  # the first of this start, before which all may take its time
            self._since = dict.fromkeys(self._since, time.time())
        self._spoke_last = spoke
        if record["role"] == "learner":
            self._is_trained = bool(record.get("finished"))

    def _note_checkpoint(self, record: dict[str, Any]) -> None:
        update, steps = _steps(record.get("checkpoint_update")), _steps(record.get("checkpoint_env_steps"))
        if record["role"] != "learner" or update is None or steps is None:
            return
        self._checkpoints.pop(update, None)
        self._checkpoints[update] = steps  # last
        if len(self._checkpoints) > MOST_CHECKPOINTS:
            del self._checkpoints[next(iter(self._checkpoints))]

    def _note_movement(self, spoke_at: float) -> None:
        """When the counters last grew, by the learner's clock; a pause of it, as between starts, does not count."""
        counted = self.env_steps, int(_number(self.get("learner", "updates")))
        if counted != self._counted or spoke_at - self._spoke_at > PAUSE_SECONDS:
            self._counted, self._moved_at = counted, spoke_at
        self._spoke_at = spoke_at

    def take_evaluation(self, record: dict[str, Any]) -> None:
        """Take in what a record says of an evaluation, if it is one: half of an evaluation is none."""
        score, deviation = record.get("eval_return_mean"), record.get("eval_return_std")
        if record["role"] != "evaluator" or not is_finite(score) or not is_finite(record.get("eval_update")):
            return
        deviation = deviation if is_finite(deviation) else None
        at = _steps(record.get("eval_env_steps"))
        self.last = EvaluationStatus(float(score), deviation, _steps(record["eval_update"]), at, is_complete(record))
        if self.last.is_complete and (self.best is None or self.last.return_mean > self.best.return_mean):
            self.best = self.last

    def silent(self) -> dict[str, float]:
        """Who has said nothing for long, and for how many seconds. While Redis is away, which is why, it alone."""
        if not self._is_training:
            return {}
        now, launcher = time.time(), self.roles.get("launcher", {})
        if launcher.get("redis_away_s"):
            return {"Redis": launcher["redis_away_s"] + now - launcher.get("time", now)}
        heard = self.of_this_start()
        unheard = {role: now - since for role, since in self._since.items() if role not in heard}
        return {role: seconds for role, seconds in unheard.items() if seconds > UNHEARD_SECONDS} | self._quiet(heard)

    def speaking(self) -> set[str]:
        """Who has said something of late, or cannot, as Redis is away."""
        heard = self.of_this_start()
        return set(heard) - set({} if self.get("launcher", "redis_away_s") else self._quiet(heard))

    def _quiet(self, heard: dict[str, dict[str, Any]]) -> dict[str, float]:
        now = time.time()
        quiet = {role: now - record.get("time", now) for role, record in heard.items() if self.heard in ("*", role)}
        return {
            role: seconds
            for role, seconds in sorted(quiet.items())
            if seconds > (LAUNCHER_SECONDS if role == "launcher" else SILENT_SECONDS)
        }

    @property
    def _is_training(self) -> bool:
        """Whether roles are to speak: not before the first word of this start, nor once the learner is at its end."""
        return not (self.is_past or self.is_over or self._is_trained) and self._spoke_last >= self._began

    @property
    def stalled_s(self) -> float:
        """Seconds without a step and an update while learner, replay servers and actors all wait; 0 where one works."""
        said = {role: record for role, record in self.of_this_start().items() if role not in ("launcher", "evaluator")}
        work = [role for role, record in said.items() if _number(record.get("waiting_share")) < WAITING_SHARE]
        if work or not self._is_training or self.silent() or self.get("learner", "waiting_for") in (None, "disk"):
            return 0.0
        return max(0.0, _number(self.get("learner", "time")) - self._moved_at)

    def of_this_start(self) -> dict[str, dict[str, Any]]:
        """The roles that have spoken since the launcher's newest start: one before may have had others."""
        launcher = self.roles.get("launcher", {})
        if not (is_finite(launcher.get("time")) and is_finite(launcher.get("start_s"))):
            return self.roles
        began = launcher["time"] - launcher["start_s"] - LAUNCHER_SECONDS
        return {role: said for role, said in self.roles.items() if "time" not in said or _number(said["time"]) >= began}

    def get(self, role: str, name: str) -> Any:
        """The newest value, or None."""
        return self.roles.get(role, {}).get(name)

    @property
    def env_steps(self) -> int:
        """Agent steps committed to the ring."""
        if self.final_steps is not None:
            return self.final_steps
        said = [of for role, of in self.roles.items() if role.startswith("replay") and "env_steps" in of]
        steps = sum(one["env_steps"] for one in said) or self.get("learner", "env_steps")  # also of earlier starts
        return max(_steps(steps) or 0, self.steps_before)  # one of several replay servers may speak first

    @property
    def share_done(self) -> float:
        """Agent steps over the run's total, 0 to 1."""
        return min(1.0, self.env_steps / max(1, self.total_steps))

    @property
    def elapsed_s(self) -> float | None:
        """Seconds trained, over all starts of the run."""
        wall_s, spoke = self.get("launcher", "wall_s"), self.get("launcher", "time")
        if not is_finite(wall_s):
            return None
        trains = not self.is_over and is_finite(spoke) and spoke >= self._began  # between two starts none does
        return float(wall_s) + (max(0.0, time.time() - spoke) if trains else 0.0)

    @property
    def eta_s(self) -> float | None:
        """Seconds to the end at the rate of the last minute of this start; None where that is not known yet."""
        rate = self._pace.steps_per_s
        if rate is None or self.is_over or "Redis" in self.silent():
            return None
        return max(0, self.total_steps - self.env_steps) / rate

    def checkpoint_steps(self, update: int | None) -> int | None:
        """Agent steps at the checkpoint of that update, or None where the learner has not said them."""
        return None if update is None else self._checkpoints.get(update)

    def replay(self, name: str, over: Callable[[list[float]], float]) -> float | None:
        """The sum or mean ``over`` all replay servers, or None."""
        return self.aggregate("replay", name, over)

    def aggregate(self, kind: str, name: str, how: Callable[[list[float]], float]) -> float | None:
        """The sum or mean over all roles of this start whose name begins with ``kind``, or None."""
        said = self.of_this_start().items()
        values = [record[name] for role, record in said if role.startswith(kind) and name in record]
        return how(values) if values else None

    @property
    def episode_return(self) -> float | None:
        """Mean of the actors' newest episode returns."""
        return self.aggregate("actor-", "episode_return_mean", mean)

    @property
    def broken_episodes(self) -> int:
        """How many the environment's own faults have ended, of evaluations those of the newest."""
        names, said = ("broken_episodes", "eval_broken_episodes"), self.of_this_start().values()
        return sum(record.get(name, 0) for record in said for name in names)


def _number(value: Any) -> float:
    """A number out of a record, 0 where it is none."""
    return value if is_finite(value) else 0.0


def _steps(value: Any) -> int | None:
    """Steps out of a record; None where they can be none."""
    return min(int(value), LARGEST_STEP) if is_finite(value) and value >= 0 else None
