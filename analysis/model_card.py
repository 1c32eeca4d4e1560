"""A policy's model card: what the hub shows of it."""

import re
from typing import Any

from rmc.common.policy_header import PolicyHeader

TEXT = """---
{data}
---

# {env} by RMC

A recurrent policy for `{env}`, trained with [RMC](https://arxiv.org/abs/1908.11494), preset `{preset}`, seed {seed}.

| | |
|---|---|
| environment | {label} |
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
OURS = re.compile(r"# [^\n]* by RMC\n.*?\nThe file's header has [^\n]*\n", re.DOTALL)  # that part of a card


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
        label=header.env.label(),
        preset=header.preset,
        seed=header.seed,
        judged=header.returns() or "not evaluated",
        steps=header.env_steps,
        sizes=", ".join(map(str, header.sizes().values())),
        rmc=header.rmc,
        repo=repo,
    )


def renewed(there: str, new: str) -> str:
    """A card that is there with RMC's part and figures of a ``new`` one. What its owner wrote stays.

    One of the owner's own, without that part, takes the license alone. One without text is replaced.
    """
    from huggingface_hub import ModelCard  # an extra

    old, now = (ModelCard(text, ignore_metadata_errors=True) for text in (there, new))
    given = now.data.get("license")
    old.data["license"] = given or old.data.get("license")
    if old.text.strip() and not OURS.search(old.text):
        return str(old) if given else there
    part = OURS.findall(now.text)[0]
    for name in ("eval_results", "library_name", "model_name", "pipeline_tag"):
        old.data[name] = now.data.get(name)
    old.data["tags"] = [*dict.fromkeys([*now.data["tags"], *(old.data.get("tags") or [])])]
    old.text = OURS.sub(lambda _: part, old.text, count=1) if old.text.strip() else now.text
    return str(old)


def _results(header: PolicyHeader) -> list[Any] | None:
    """Its evaluation as the hub reads it: None where there was none, or of an environment that was changed."""
    from huggingface_hub import EvalResult  # an extra

    if not header.returns() or header.env.label() != header.env.id:  # the hub compares by the id
        return None
    result = EvalResult(
        task_type="reinforcement-learning",
        dataset_type=header.env.id,
        dataset_name=header.env.id,
        metric_type="mean_reward",
        metric_value=f"{header.eval_return_mean:.2f} +/- {header.eval_return_std:.2f}",
    )
    return [result]
