"""Stored state + burn-in gives the learner the very h that the actor had, at every trained step."""

import dataclasses

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rmc.actors.window_builder import Transition, WindowBuilder
from rmc.common.agent_config import AgentConfig
from rmc.common.window import Rows, WindowSpec, joined
from rmc.learner.batch import Batch, view_batch
from rmc.learner.unroll import impute_and_unroll
from tests.actors.test_policy_runner import ACTION_DIM, OBS_DIM, make_agent, make_runner

HIDDEN = 16
AGENTS = {
    shape: make_agent(
        AgentConfig(
            hidden=HIDDEN,
            embedding=embedding,
            heads=(8, 8),
            head_input="hidden+observation",
            normalize_observations=True,
            missing_flag=bool(embedding),
        )
    )
    for shape, embedding in (("embedded", 12), ("raw", 0))
}
FILLING = dataclasses.replace(AGENTS["embedded"].config, head_input="hidden+observation", impute_missing=True)
AGENTS["filled"], AGENTS["filled by number"] = (make_agent(FILLING, missing=flags) for flags in (1, OBS_DIM))


def play(
    agent_name: str, spec: WindowSpec, stride: int, lengths: list[int], seed: int
) -> tuple[Rows, list[np.ndarray]]:
    """Windows of as many environments as ``lengths``, each of which ends its episodes at that length.

    An observation ends in its environment and its time / 100, which is where in ``states``, time -> (N, H),
    the actor's own h is found.
    """
    runner, envs = make_runner(AGENTS[agent_name], len(lengths), spec.missing), len(lengths)
    builder = WindowBuilder(spec, stride, envs, capacity=envs)
    rng = np.random.default_rng(seed)
    rows, states = [], []

    def observe(time: int) -> np.ndarray:
        observation = rng.normal(0, 2, (envs, OBS_DIM)).astype(np.float32)
        observation[:, -2], observation[:, -1] = range(envs), time / 100
        return observation

    for env, observation in enumerate(observe(0)):
        builder.begin(env, observation, missing=False)
    for time in range(1, 3 * max(lengths) + 1):
        action, hidden = runner.act(*builder.now(), rng.standard_normal((envs, ACTION_DIM), np.float32))
        states.append(hidden[:, :HIDDEN].copy())
        done, terminates = np.array([time % length == 0 for length in lengths]), rng.random(envs) < 0.5
        missing = rng.random((envs, spec.missing)) < 0.2
        nothing, privileged = np.zeros(envs, np.float32), np.zeros((envs, spec.privileged), np.float32)
        step = Transition(nothing, observe(time), missing, done & terminates, done & ~terminates, privileged)
        ended = builder.add(action, hidden, 1, step)
        for env in np.flatnonzero(ended).tolist():
            builder.begin(env, observe(time)[env], missing=False)
        rows.append(builder.take().copy())
    return joined(rows, spec), states


@torch.no_grad()
def relearned(agent_name: str, rows: Rows, spec: WindowSpec) -> tuple[Batch, torch.Tensor]:
    """The learner's own way from rows to h, (B, train + 1, H)."""
    agent = AGENTS[agent_name]
    raw = torch.from_numpy(rows.view(np.uint8).reshape(len(rows), -1))
    batch = view_batch(raw, torch.ones(len(rows)), spec)
    o = agent.normalizer(batch.observation, batch.missing)
    return batch, impute_and_unroll(agent, o, batch)[1].hidden


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(sorted(AGENTS)),
    st.integers(0, 7),
    st.integers(1, 8),
    st.data(),
    st.lists(st.integers(1, 40), min_size=1, max_size=4),
    st.integers(0, 2**31),
)
def test_the_learner_reproduces_the_actors_memory(
    agent_name: str, burn_in: int, train: int, data: st.DataObject, lengths: list[int], seed: int
) -> None:
    state = AGENTS[agent_name].config.state_size(OBS_DIM)
    flags = OBS_DIM if agent_name == "filled by number" else 1
    spec = WindowSpec(OBS_DIM, ACTION_DIM, state, burn_in, train, flags)
    rows, states = play(agent_name, spec, data.draw(st.integers(1, train), label="stride"), lengths, seed)
    rows = rows[data.draw(st.permutations(range(len(rows))), label="batch positions")]
    batch, hidden = relearned(agent_name, rows, spec)
    compared = 0
    for b, row in enumerate(rows):
        for t in range(burn_in, int(row["last"])):
            env, time = int(row["observation"][t, -2]), round(float(row["observation"][t, -1]) * 100)
            np.testing.assert_allclose(hidden[b, t - burn_in], states[time][env], atol=1e-5)
            compared += 1
    assert compared == int(batch.step_valid[:, burn_in:].sum()) > 0
