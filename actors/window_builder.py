"""Cuts the steps of N environments into windows: order, episode ends, burn-in, stored state.

Shapes: N environments, T = burn_in + train, O observation, A action, S state (see ``AgentConfig.state_size``), M flags
of what is missing, P privileged numbers.

All environments step together, so one ring of T + 1 slots over time serves them all. A slot holds what
is known when an observation arrives: it, the action, reward and weights version that led to it, and the
GRU state before it. ``k`` below counts the steps of an episode.
"""

from typing import NamedTuple

import numpy as np

from rmc.common.window import BoolArray, Floats, Rows, WindowSpec


class Now(NamedTuple):
    """What a policy acts on; views that are valid for T more calls of ``add``."""

    observation: Floats  # (N, O)
    prev_action: Floats  # (N, A)
    missing: BoolArray  # (N, M)
    state: Floats  # (N, S), the state before ``observation``


class Transition(NamedTuple):
    """A step of every environment; of an ended episode the observation is its final one."""

    reward: Floats  # (N,)
    observation: Floats  # (N, O)
    missing: BoolArray  # (N, M)
    terminated: BoolArray  # (N,)
    truncated: BoolArray  # (N,)
    privileged: Floats  # (N, P)


class WindowBuilder:
    """Finished windows are written one after another into ``rows``; ``take`` hands them over.

    A trained block starts at k = 0, stride, 2 stride, …; its window is finished when the block is full or
    the episode ends. With stride = train every step stands in exactly one trained slot. The burn-in is real
    where at least burn_in steps came before the block. ``weights_update`` of a row is that of the policy that
    acted at the first trained step.
    """

    def __init__(self, spec: WindowSpec, stride: int, envs: int, capacity: int, store_states: bool = True) -> None:
        """``capacity`` rows fit between two ``take``; at least ``envs``, as one ``add`` may finish that many.

        Without ``store_states`` every window says that its memory starts from zeros.
        """
        assert 1 <= stride <= spec.train, (stride, spec.train)
        assert capacity >= envs, (capacity, envs)
        self._spec, self._stride, self._envs, self._store_states = spec, stride, envs, store_states
        self._slots = slots = spec.observations
        self._observation = np.zeros((slots, envs, spec.obs_dim), np.float32)
        self._missing = np.zeros((slots, envs, spec.missing), np.bool_)
        self._privileged = np.zeros((slots, envs, spec.privileged), np.float32)
        self._prev_action = np.zeros((slots, envs, spec.action_dim), np.float32)
        self._reward = np.zeros((slots, envs), np.float32)
        self._state = np.zeros((slots, envs, spec.state), np.float32)
        self._update = np.zeros(slots, np.int64)
        self._time = 0  # of the newest observation; its slot is time mod slots
        self._start = np.zeros(envs, np.int64)  # time of each episode's first observation
        self._block = np.zeros(envs, np.int64)  # k where the open trained block starts
        self._covered = np.zeros(envs, np.int64)  # steps of the episode that finished windows hold
        self._range = np.arange(slots)
        self._open_rows(capacity)

    def _open_rows(self, capacity: int) -> None:
        self._rows = np.zeros(capacity, self._spec.dtype)
        self._raw = self._rows.view(np.uint8).reshape(capacity, -1)
        self._fields = {name: self._rows[name] for name in self._rows.dtype.names or ()}
        self.count = 0

    @property
    def open(self) -> bool:
        """Whether any step is in no finished window yet."""
        return bool((self._time - self._start > self._covered).any())

    def now(self) -> Now:
        """The newest observations, and the memory before them."""
        slot = self._time % self._slots
        return Now(self._observation[slot], self._prev_action[slot], self._missing[slot], self._state[slot])

    def begin(self, env: int, observation: Floats, missing: bool | BoolArray, privileged: Floats | None = None) -> None:
        """A new episode: (O,) its first observation, with (M,) and (P,); what was open before is forgotten."""
        slot = self._time % self._slots
        self._observation[slot, env] = observation
        self._missing[slot, env] = missing
        if privileged is not None:
            self._privileged[slot, env] = privileged
        self._prev_action[slot, env] = 0.0
        self._state[slot, env] = 0.0
        self._start[env] = self._time
        self._block[env] = self._covered[env] = 0

    def end_before(self, env: int) -> None:
        """Truncate an episode whose next step must not be trusted; ``add``, then ``begin`` must follow."""
        self._finish(env, terminated=False)
        self._start[env] = self._time + 1
        self._block[env] = self._covered[env] = 0

    def add(self, action: Floats, state: Floats, update: int, step: Transition) -> BoolArray:
        """One step of every environment: (N, A), (N, S) state after ``now().observation``, and what came of it.

        ``update`` is that of the weights that acted. Returns (N,) which episodes have ended; ``begin`` must follow for
        each of them.
        """
        self._time += 1
        slot = self._time % self._slots
        self._prev_action[slot] = action
        self._state[slot] = state
        self._update[slot] = update
        self._reward[slot] = step.reward
        self._observation[slot] = step.observation
        self._missing[slot] = step.missing
        self._privileged[slot] = step.privileged
        ended = step.terminated | step.truncated
        steps = self._time - self._start
        for env in np.flatnonzero(ended | (steps - self._block == self._spec.train)).tolist():
            self._finish(env, bool(step.terminated[env]))
        return ended

    def cut(self) -> None:
        """Finish every open window, as a truncated episode would; ``begin`` must follow for all."""
        for env in range(self._envs):
            self._finish(env, terminated=False)

    def take(self) -> Rows:
        """The finished rows, a view that the next ``add`` overwrites."""
        rows, self.count = self._rows[: self.count], 0
        return rows

    def _finish(self, env: int, terminated: bool) -> None:
        """Write the window of the open block up to the newest observation, if it holds a new step."""
        steps = int(self._time - self._start[env])
        block, covered = int(self._block[env]), int(self._covered[env])
        if steps == covered:
            return
        burn_in = self._spec.burn_in
        first = 0 if block >= burn_in else burn_in
        last = burn_in + steps - block
        slots = (self._range[first : last + 1] + (self._time - last)) % self._slots
        row, fields = self.count, self._fields
        self._raw[row] = 0
        fields["first"][row], fields["last"][row], fields["terminated"][row] = first, last, terminated
        fields["new_steps"][row] = steps - covered
        fields["new_observations"][row] = steps - covered + (covered == 0)
        fields["env"][row], fields["episode_step"][row] = env, block
        fields["weights_update"][row] = self._update[(self._time - last + burn_in + 1) % self._slots]
        fields["observation"][row, first : last + 1] = self._observation[slots, env]
        fields["missing"][row, first : last + 1] = self._missing[slots, env]
        if self._spec.privileged:
            fields["privileged"][row, first : last + 1] = self._privileged[slots, env]
        fields["action"][row, first:last] = self._prev_action[slots[1:], env]
        fields["reward"][row, first:last] = self._reward[slots[1:], env]
        fields["prev_action"][row] = self._prev_action[slots[0], env]
        if self._store_states:
            fields["state"][row] = self._state[slots[0], env]
        self.count += 1
        self._covered[env] = steps
        self._block[env] = block + self._stride
