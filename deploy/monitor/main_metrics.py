"""The few metrics that are looked at first, in TensorBoard and in every tracker."""

from statistics import mean
from typing import Any

from rmc.common.bus.metrics_record import is_complete, is_finite
from rmc.deploy.monitor.run_status import RunStatus

MAIN = "Main/"  # TensorBoard sorts capitals before the roles' names


def main_metrics(status: RunStatus) -> dict[str, float]:
    """Rates, waiting shares, losses and the training return, as far as they are known."""
    learner = status.roles.get("learner", {})
    waits = {
        "waiting_share_learner": learner.get("waiting_share"),
        "waiting_share_replay": status.replay("waiting_share", mean),
        "waiting_share_actors": status.aggregate("actor-", "waiting_share", mean),
    }
    losses = {name: value for name, value in learner.items() if name.endswith("_loss")}
    metrics: dict[str, Any] = {
        "env_steps_per_s": status.replay("env_steps_per_s", sum),
        "updates_per_s": learner.get("updates_per_s"),
        "episode_return": status.episode_return,
        **waits,
        **losses,
    }
    return {MAIN + name: float(value) for name, value in metrics.items() if is_finite(value)}


def evaluation_metrics(record: dict[str, Any]) -> dict[str, float]:
    """What a record says of an evaluation; empty where it is none, or an episode was cut or broken."""
    names = {"evaluation_return": "eval_return_mean", "evaluation_return_std": "eval_return_std"}
    if record["role"] != "evaluator" or not is_complete(record):
        return {}
    return {MAIN + name: float(record[key]) for name, key in names.items() if is_finite(record.get(key))}
