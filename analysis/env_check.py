"""``rmc check-env``: plays an environment at random and says what the agent will make of it, and what to fix."""

import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils.env_checker import check_env as gymnasiums_checks
from numpy.typing import NDArray
from rich.console import Console

from rmc.common.agent_config import STD_FLOOR
from rmc.common.env.config import EnvConfig
from rmc.common.env.describe import layout_of
from rmc.common.env.faults import PASSED_ON, describe_error
from rmc.common.env.layout import EnvLayout
from rmc.common.env.make import first_env, make_env
from rmc.common.env.privileged import Privileged
from rmc.common.env.process_state import changes
from rmc.common.env.watched_env import WatchedEnv
from rmc.common.env.wrappers import Env
from rmc.common.errors import EnvFault
from rmc.common.window import BoolArray, Floats
from rmc.deploy.run.config import WindowConfig
from rmc.deploy.run.env_sizes import env_sizes, layout_sizes
from rmc.deploy.run.memory_reach import format_reach
from rmc.deploy.run.validation import validate_new_env

BESIDE_THE_POINT = (  # of vectors, stretched actions, what watches the environment, and what is judged better below
    "is -infinity", "is infinity", "symmetric and normalized", "different from the unwrapped version",
    "is non-deterministic as", "truncates after 1 step",
)  # fmt: skip
REPEATED_STEPS = 50  # played twice from one seed
LARGE_REWARD = 100.0  # mean size of a step's reward from which the critics start far from their target
LARGEST_REWARD = 1e4  # of one step, from which it outweighs all others in a batch
SMALL_REWARD = 1e-3  # largest size of a step's reward up to which the critics see nothing of it
LISTED = 20  # dimensions named in a note
LARGEST_SEED = 2**31 - 1  # with which training may begin an episode
LARGE_OBSERVATION = 1e4  # from which float32 and a running mean lose precision


@dataclass
class Played:
    """What random episodes gave."""

    observations: list[Floats] = field(default_factory=list)  # NaN where they were missing
    rewards: list[float] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)  # of episodes that ended
    terminated: int = 0
    seconds: float = 0.0
    missing: list[float] = field(default_factory=list)  # shares of the observations that steps gave

    def play(self, env: Env, steps: int, seed: int) -> None:
        """So many steps with uniform actions. Raises what the environment raises."""
        rng, length = np.random.default_rng(seed), 0
        self._see(*env.reset(seed=seed))
        for _ in range(steps):
            start = time.perf_counter()
            action = rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
            observation, reward, terminated, truncated, info = env.step(action)
            self.seconds += time.perf_counter() - start
            self._see(observation, info)
            self.rewards.append(float(reward))
            self.missing.append(float(np.mean(info.get("missing", False))))
            length += 1
            if terminated or truncated:
                self.lengths.append(length)
                self.terminated += bool(terminated)
                self._see(*env.reset())
                length = 0

    def _see(self, observation: Floats, info: dict[str, Any]) -> None:
        self.observations.append(np.where(info.get("missing", False), np.float32(np.nan), observation))


def check(config: EnvConfig, steps: int, console: Console) -> int:
    """Print facts, notes and faults; 0 where there is no fault, else 1. Raises ConfigError as ``rmc train`` would."""
    validate_new_env(config)
    env, played = first_env(config), Played()
    layout = layout_of(env, config, {}, privileged=False)
    stages: list[Callable[[], Iterable[str]]] = [
        lambda: _gymnasiums_notes(WatchedEnv(_users(env), config.id, config.env_timeout)),
        lambda: _guarded(lambda: played.play(env, steps, seed=0)),
        lambda: _nonsense(played),
        lambda: _hints(played, layout.time_limit),
        lambda: _repeated(env),
        lambda: _for_critics(env),
        lambda: _second(config, layout),
    ]
    lines: list[str] = []
    while stages and not _faults(lines):  # what comes later needs what was before to be sound
        lines += stages.pop(0)()
    if changed := changes():
        lines.append(f"note: it changes {', '.join(changed)} of its process; training keeps its own apart")
    reach = format_reach(WindowConfig().trained_steps, layout.time_limit)  # by default
    for line in [*_facts(layout, played), reach, *dict.fromkeys(lines)]:
        console.print(line, soft_wrap=True)
    env.close()
    sound = not _faults(lines)
    console.print("it can be trained on" if sound else "fix the fault first")
    return 0 if sound else 1


def _users(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """As it was made, with the user's own wrappers and none of ours."""
    while isinstance(env, gym.Wrapper) and not isinstance(env, WatchedEnv):
        env = env.env
    return env.env if isinstance(env, WatchedEnv) else env


def _faults(lines: list[str]) -> list[str]:
    return [text for text in lines if text.startswith("fault: ")]


def _gymnasiums_notes(env: gym.Env[Any, Any]) -> Iterator[str]:
    """What gymnasium's own checks find: worth a look, but what counts is whether it can be played."""
    for text in _guarded(lambda: gymnasiums_checks(env, skip_render_check=True, skip_close_check=True)):
        if not any(words in text for words in BESIDE_THE_POINT):
            yield "note: gymnasium says: " + text.partition(": ")[2]


def _guarded(action: Callable[[], None]) -> Iterator[str]:
    """What was raised, as a fault, and what was warned of, as notes."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            action()
        except EnvFault as fault:
            yield f"fault: {fault}"
        except PASSED_ON:
            raise
        except BaseException as error:  # whatever a user's environment raises is a finding
            yield f"fault: {describe_error(error)}"
    for text in dict.fromkeys(_plain(str(warning.message)) for warning in caught):
        yield f"note: {text}"


def _plain(text: str) -> str:
    """Without gymnasium's colours and its name for a warning."""
    return " ".join(text.replace("\x1b[33m", "").replace("\x1b[0m", "").removeprefix("WARN: ").split())


def _facts(layout: EnvLayout, played: Played) -> Iterator[str]:
    yield f"observations {layout.obs_dim}, actions {layout.action_dim}, time limit {layout.time_limit or 'none'}"
    if played.rewards:
        rewards = np.array(played.rewards)
        speed = len(rewards) / played.seconds
        yield f"{len(rewards):,} random steps, {speed:,.0f} a second; reward {rewards.mean():.3g} ± {rewards.std():.3g}"
    if any(played.missing):
        yield f"{np.mean(played.missing):.0%} of what is observed is missing"
    if played.lengths:
        ended = f"{played.terminated} of them terminated"
        shortest, longest = min(played.lengths), max(played.lengths)
        steps = f"{shortest} to {longest}" if shortest < longest else f"{longest}"
        yield f"{len(played.lengths)} episode{'s' * (len(played.lengths) != 1)} of {steps} steps, {ended}"


def _nonsense(played: Played) -> Iterator[str]:
    if not np.isfinite(played.rewards).all():
        yield "fault: rewards are not finite; the episode ends a step before, and the environment is made anew"
    largest = max(map(abs, played.rewards), default=0.0)
    if float(np.finfo(np.float32).max) < largest < np.inf:
        yield f"fault: rewards reach {largest:.3g}, past what float32 holds (3e+38); scale them in the environment"


def _hints(played: Played, time_limit: int | None) -> Iterator[str]:
    observations, rewards = np.stack(played.observations, dtype=np.float64), np.array(played.rewards)
    seen = ~np.isnan(observations).all(0)
    observations[:, ~seen] = 0.0
    still = seen & (np.nanmax(observations, 0) == np.nanmin(observations, 0))
    faint = seen & ~still & (np.nanstd(observations, 0) < STD_FLOOR)
    if still.any():
        yield f"note: observations {_listed(still)} never changed"
    if faint.any():
        yield f"note: observations {_listed(faint)} vary by less than {STD_FLOOR}; scale them up in the environment"
    if np.nanmax(np.abs(observations)) > LARGE_OBSERVATION:
        yield f"note: observations reach {np.nanmax(np.abs(observations)):.3g}; scale them in the environment"
    yield from _reward_notes(np.abs(rewards))
    if not rewards.any():
        yield "note: no random step was rewarded; learning will need luck, or curiosity (--curiosity)"
    if not played.lengths and not time_limit:
        yield "note: no episode ended; without a time limit an evaluation stops at 10 000 steps (--time-limit)"


def _repeated(env: Env) -> Iterator[str]:
    """Whether the same seed and actions give the same observations."""
    twice = Played(), Played()

    def play_both() -> None:
        for one in twice:
            one.play(env, REPEATED_STEPS, seed=LARGEST_SEED)

    yield from _guarded(play_both)
    once, again = (one.observations for one in twice)
    if len(twice[1].rewards) == REPEATED_STEPS and not np.array_equal(once, again, equal_nan=True):
        yield "note: the same seed and actions gave other observations; runs will not be repeatable"


def _for_critics(env: Env) -> Iterator[str]:
    """Whether ``--privileged-critic`` could take what the environment gives under that name, if it does."""
    watched = Privileged(env, take_observation=False)
    try:
        given = watched.reset(seed=2)[1].get("privileged")
        Played().play(watched, REPEATED_STEPS, seed=2)
    except EnvFault as fault:
        yield f"note: --privileged-critic would end in: {fault}"
        return
    if given is not None:
        yield f'note: info["privileged"] has {given.size} numbers, which critics alone read with --privileged-critic'


def _second(config: EnvConfig, layout: EnvLayout) -> Iterator[str]:
    """Whether another one of the same sizes can be played while the first is there, as in training."""
    try:
        with closing(make_env(config)) as env:
            sizes = env_sizes(env, config)
            Played().play(env, 1, seed=0)  # as the first one stood it
    except Exception as error:
        fix = "take --actors 1 --envs-per-actor 1 --episodes 0"
        yield f"note: no second one can be beside it ({describe_error(error)}); {fix}"
        return
    for name, size in layout_sizes(layout).items():
        if sizes[name] != size:
            yield f"fault: {name} of a second one are {sizes[name]}, of the first {size}; give each the same"


def _reward_notes(sizes: NDArray[np.float64]) -> Iterator[str]:
    """After the scale that is proposed, the mean size is 1 at most, and the largest a hundred."""
    scale = min(1.0 / max(sizes.mean(), 1e-300), LARGE_REWARD / max(sizes.max(), 1e-300))
    if sizes.mean() > LARGE_REWARD or sizes.max() > LARGEST_REWARD:
        yield f"note: rewards are large, up to {sizes.max():.3g} a step; try --reward-scale {scale:.1g}"
    if 0.0 < sizes.max() < SMALL_REWARD:
        yield f"note: rewards are small, {sizes.max():.3g} a step at most; try --reward-scale {scale:.1g}"


def _listed(chosen: BoolArray) -> str:
    """The numbers of those that are."""
    numbers = np.flatnonzero(chosen).tolist()
    shown = ", ".join(map(str, numbers[:LISTED]))
    return f"{shown} and {len(numbers) - LISTED} more" if len(numbers) > LISTED else shown
