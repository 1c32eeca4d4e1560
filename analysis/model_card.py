"""A policy's model card: what the hub shows of it."""

from typing import Any

from rmc.common.policy_header import PolicyHeader

TEXT = """---
{data}
---

# {env} by RMC

A recurrent policy for `{env}`, trained with [RMC](https://arxiv.org/abs/1908.11494), preset `{preset}`, seed {seed}.

| | |
|---|---|
| return, mean ± deviation | {judged} |
| agent steps | {steps:,} |
| observation, action, state | {sizes} |
| written by RMC | {rmc} |

```python
from rmc import load_policy  # pip install 'rmc-rl[hub]'

policy = load_policy("hf://{repo}")
policy.reset()  # at the start of every episode
action = policy.act(observation, units="environment")
```

The file's header has the observation's layout, the action's bounds and all options of the environment.
"""


def card(header: PolicyHeader, repo: str, license_id: str | None) -> str:
    """Its text, with the data that the hub reads in front; the license is left to whoever pushes."""
    from huggingface_hub import ModelCardData  # an extra

    data = ModelCardData(
        license=license_id,
        library_name="rmc",
        pipeline_tag="reinforcement-learning",
        tags=["reinforcement-learning", "rmc", header.env.id],
        model_name=repo.rpartition("/")[2],
        eval_results=_results(header),
    )
    return TEXT.format(
        data=data.to_yaml(),
        env=header.env.id,
        preset=header.preset,
        seed=header.seed,
        judged=header.returns() or "not evaluated",
        steps=header.env_steps,
        sizes=", ".join(map(str, header.sizes().values())),
        rmc=header.rmc,
        repo=repo,
    )


def _results(header: PolicyHeader) -> list[Any] | None:
    """Its evaluation as the hub reads it, None where there was none."""
    from huggingface_hub import EvalResult  # an extra

    if not header.returns():
        return None
    result = EvalResult(
        task_type="reinforcement-learning",
        dataset_type=header.env.id,
        dataset_name=header.env.id,
        metric_type="mean_reward",
        metric_value=f"{header.eval_return_mean:.2f} +/- {header.eval_return_std:.2f}",
    )
    return [result]
