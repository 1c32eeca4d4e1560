"""The policy as its weights' average over the last updates, or as the newest: the same runs, each checkpoint as both.

After the runs, ``python -m studies.averaging --play`` plays what a checkpoint holds, the average, and what its learner
state has, the newest, from the same starts, and tells means and worst cases of the second half.
"""

from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch

from rmc.analysis.evaluation import evaluate_policy
from rmc.analysis.history import objects
from rmc.analysis.policy_file import PolicyFile, read_policy
from rmc.analysis.world_model_picture import load_agent
from rmc.common.checkpoint import CheckpointFolder
from rmc.deploy.run.folder import RunFolder
from rmc.sweep.job import Job
from studies.study import Play, Scale, Study, before

EPISODES = 10
STUDY = Study(
    "averaging",
    {
        "RMC": "train ENV --keep-checkpoints 1000",
        "RMC, target critics": before("--keep-checkpoints 1000"),
        "over 500 updates": before("--keep-checkpoints 1000 --policy-ema-updates 500"),
        "over 8 000 updates": before("--keep-checkpoints 1000 --policy-ema-updates 8000"),
    },
    small=Scale(300_000, (1, 2, 3), ("Hopper-v5", "Walker2d-v5", "HalfCheetah-v5")),
)


def play(job: Job, episodes: int = EPISODES) -> dict[str, Any]:
    """A line: returns of a run's checkpoints as both."""
    folder = RunFolder(job.folder)
    config, steps, averaged, newest = folder.config(), [], [], []
    for number in CheckpointFolder(folder.checkpoints).numbers():
        result = evaluate_policy(read_policy(folder.path, str(number)), episodes)
        steps.append(result["env_steps"])
        averaged.append(result["eval_return_mean"])
        blob = safetensors.torch.save(load_agent(folder, config, str(number)).policy_weights())
        policy = PolicyFile(config.policy_header(), blob)
        newest.append(evaluate_policy(policy, episodes)["eval_return_mean"])
    about = {**job.values, "seed": job.seed}
    return about | {"env_steps": steps, "averaged": averaged, "newest": newest}


def report(path: Path) -> None:
    """The second half of each run."""
    for line in objects(path, "agent", "env", "seed", "env_steps", "averaged", "newest").values():
        _report_run(line)


def _report_run(line: dict[str, Any]) -> None:
    half = np.array(line["env_steps"]) > max(line["env_steps"]) / 2
    for name in ("averaged", "newest"):
        returns = np.array(line[name])[half]
        spread = f"mean {returns.mean():,.0f}, worst {returns.min():,.0f}, deviation {returns.std():,.0f}"
        print(f"{line['agent']}, {line['env']}, seed {line['seed']}, {name}: {spread} of {len(returns)} checkpoints")


if __name__ == "__main__":
    STUDY.main(Play("played", play, report))
