"""What ``rmc evaluate`` and ``rmc.evaluate`` do: a policy's file, a run or a baseline's run, played."""

from numbers import Integral
from pathlib import Path
from typing import Any

from rmc.analysis.evaluation import FINAL_EPISODES, Watch, evaluate_policy
from rmc.analysis.policy_file import PolicyFile, read_policy
from rmc.common.env.config import check_range
from rmc.common.errors import ConfigError
from rmc.common.extra import check_installed
from rmc.common.user_path import user_path
from rmc.deploy.run.folder import RunFolder

MOST_EPISODES = 10_000


def evaluate_run(
    source: str | Path | PolicyFile,
    episodes: int = FINAL_EPISODES,
    checkpoint: str = "latest",
    flicker: float | None = None,
    seconds: float = 0.0,
    watch: Watch = lambda _: None,
    baseline_timeout: float | None = None,
) -> dict[str, Any]:
    """As ``evaluate_policy``: a policy, read or its file, or a run's checkpoint; of a baseline's run its last state.

    Raises ConfigError; RmcError where the environment breaks in every episode.
    """
    check_range("--episodes", episodes, (1, MOST_EPISODES), Integral)
    if flicker is not None:
        check_range("--flicker", flicker, (0.0, 1.0))
    if isinstance(source, PolicyFile) or not is_baseline(source):
        policy = source if isinstance(source, PolicyFile) else read_policy(source, checkpoint)
        return evaluate_policy(policy, episodes, flicker, seconds, watch)
    if checkpoint != "latest":
        raise ConfigError("--checkpoint", checkpoint, "a baseline keeps its last state only; use latest")
    check_baselines(str(source))
    from rmc.analysis import baselines  # an extra

    return baselines.evaluate(RunFolder(user_path(source)), episodes, flicker, seconds, watch, baseline_timeout)


def is_baseline(source: str | Path) -> bool:
    """Whether it is a baseline's run."""
    folder = RunFolder(user_path(source))
    return folder.path.is_dir() and folder.is_baseline()


def check_baselines(what: str) -> None:
    """Raises ConfigError where the extra is missing, which names ``what``."""
    check_installed("baselines", ("stable_baselines3", "sb3_contrib"), "baseline", what)
