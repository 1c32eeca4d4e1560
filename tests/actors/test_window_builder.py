"""Windows: every step once, in order, inside its episode, whatever the lengths, strides and sizes."""

from collections import Counter, defaultdict
from dataclasses import dataclass

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rmc.actors.window_builder import Transition, WindowBuilder
from rmc.common.window import Rows, WindowSpec, joined
from rmc.replay_server.row_check import row_faults

OBS_DIM, ACTION_DIM, HIDDEN = 3, 3, 3


@dataclass(frozen=True)
class Play:
    """What a test plays: for every environment its episodes' lengths, ended by termination if even."""

    spec: WindowSpec
    stride: int
    lengths: list[list[int]]

    def length(self, env: int, episode: int) -> int:
        return self.lengths[env][episode % len(self.lengths[env])]


@st.composite
def plays(draw: st.DrawFn) -> Play:
    train = draw(st.integers(1, 7))
    missing, privileged = draw(st.sampled_from([1, OBS_DIM])), draw(st.integers(0, 2))
    spec = WindowSpec(OBS_DIM, ACTION_DIM, HIDDEN, draw(st.integers(0, 6)), train, missing, privileged)
    length = st.integers(1, 4 * spec.steps)
    lengths = draw(st.lists(st.lists(length, min_size=1, max_size=4), min_size=1, max_size=3))
    return Play(spec, draw(st.integers(1, train)), lengths)


def name(env: int, episode: int, k: int) -> np.ndarray:
    return np.array([env, episode, k], np.float32)


def run(play: Play, steps: int, cut: bool = True, store_states: bool = True) -> tuple[Rows, list[int]]:
    """All windows of so many steps, and each environment's number of ended episodes.

    An observation, and the state before it, is (env, episode, k); an action is its step's name negated.
    The weights version is the time.
    """
    envs = len(play.lengths)
    builder = WindowBuilder(play.spec, play.stride, envs, capacity=envs, store_states=store_states)
    episode, k = np.zeros(envs, int), np.zeros(envs, int)
    for env in range(envs):
        builder.begin(env, name(env, 0, 0), _missing(0, play.spec), _privileged(name(env, 0, 0), play.spec))
    taken = []
    for time in range(steps):
        now = builder.now()
        here = np.stack([name(env, episode[env], k[env]) for env in range(envs)])
        np.testing.assert_array_equal(now.observation, here)
        np.testing.assert_array_equal(now.state, np.where(k[:, None] > 0, here, 0))
        np.testing.assert_array_equal(now.prev_action, np.where(k[:, None] > 0, -(here - [0, 0, 1]), 0))
        k += 1
        then = here + np.float32([0, 0, 1])
        done = np.array([k[env] == play.length(env, episode[env]) for env in range(envs)])
        step = Transition(
            reward=k.astype(np.float32), observation=then, missing=np.stack([_missing(one, play.spec) for one in k]),
            terminated=done & (k % 2 == 0), truncated=done & (k % 2 == 1), privileged=_privileged(then, play.spec),
        )  # fmt: skip
        ended = builder.add(action=-here, state=then, update=time, step=step)
        np.testing.assert_array_equal(ended, done)
        for env in np.flatnonzero(ended).tolist():
            episode[env], k[env] = episode[env] + 1, 0
            first = name(env, episode[env], 0)
            builder.begin(env, first, _missing(0, play.spec), _privileged(first, play.spec))
        taken.append(builder.take().copy())
    if cut:
        builder.cut()
        taken.append(builder.take().copy())
        assert not builder.open
    return joined(taken, play.spec), episode.tolist()


def _missing(k: int, spec: WindowSpec) -> np.ndarray:
    return (k + np.arange(spec.missing)) % 5 == 3


def _privileged(named: np.ndarray, spec: WindowSpec) -> np.ndarray | None:
    return 2 * named[..., : spec.privileged] if spec.privileged else None


@given(plays(), st.integers(1, 80))
def test_without_stored_states_only_these_are_missing(play: Play, steps: int) -> None:
    stored, zero = (run(play, steps, store_states=store_states)[0] for store_states in (True, False))
    assert not zero["state"].any()
    for field in set(play.spec.dtype.names or ()) - {"state"}:
        np.testing.assert_array_equal(stored[field], zero[field])


@given(plays(), st.integers(1, 80))
def test_windows(play: Play, steps: int) -> None:
    """The whole promise of a row, against the names that its observations carry."""
    spec = play.spec
    rows, _ = run(play, steps)
    assert not row_faults(rows, spec).any()
    trained: dict[tuple[int, int], Counter[int]] = defaultdict(Counter)
    last_start: dict[tuple[int, int], int] = {}
    for row in rows:
        first, last = int(row["first"]), int(row["last"])
        env, episode, k0 = (int(x) for x in row["observation"][first])
        block = k0 + spec.burn_in - first
        assert (row["env"], row["episode_step"]) == (env, block)
        count = last - spec.burn_in
        length = play.length(env, episode)
        # order, no crossing: consecutive steps of one episode, bootstrap included
        expected = np.stack([name(env, episode, k0 + i) for i in range(last - first + 1)])
        np.testing.assert_array_equal(row["observation"][first : last + 1], expected)
        np.testing.assert_array_equal(row["action"][first:last], -expected[:-1])
        np.testing.assert_array_equal(row["reward"][first:last], expected[1:, 2])
        missing = [_missing(k0 + i, spec).tolist() for i in range(last - first + 1)]
        assert row["missing"][first : last + 1].tolist() == missing
        np.testing.assert_array_equal(row["privileged"][first : last + 1], 2 * expected[:, : spec.privileged])
        # the stored state is the one before the first real observation
        np.testing.assert_array_equal(row["state"], expected[0] if k0 else 0 * expected[0])
        np.testing.assert_array_equal(row["prev_action"], -(expected[0] - [0, 0, 1]) if k0 else 0 * expected[0])
        # burn-in is real where there were enough steps; blocks come at the stride
        assert (first == 0) == (block >= spec.burn_in)
        assert block == last_start.get((env, episode), -play.stride) + play.stride
        last_start[env, episode] = block
        # masks: everything outside is zero
        for field, end in (
            ("observation", last + 1),
            ("action", last),
            ("reward", last),
            ("missing", last + 1),
            ("privileged", last + 1),
        ):
            assert not row[field][:first].any()
            assert not row[field][end:].any()
        # ends
        assert row["terminated"] == (block + count == length and length % 2 == 0)
        assert count == spec.train or block + count == length or _is_cut(rows, row)
        # new steps and observations, each once
        counts = trained[env, episode]
        new = sum(1 for k in range(block, block + count) if not counts[k])
        assert row["new_steps"] == new > 0
        assert row["new_observations"] == new + (not counts)
        counts.update(range(block, block + count))
    _assert_complete(play, steps, trained)


def _is_cut(rows: Rows, row: np.void) -> bool:
    """Whether it is one of the windows that ``cut`` wrote: the last of its environment."""
    env = row["observation"][int(row["first"]), 0]
    same = [other for other in rows if other["observation"][int(other["first"]), 0] == env]
    return bool(same[-1].tobytes() == row.tobytes())


def _assert_complete(play: Play, steps: int, trained: dict[tuple[int, int], Counter[int]]) -> None:
    """Every step that was made stands in a trained slot; in exactly one without overlap."""
    for env in range(len(play.lengths)):
        left, episode = steps, 0
        while left > 0:
            count = min(left, play.length(env, episode))
            counts = trained[env, episode]
            assert sorted(counts) == list(range(count))
            if play.stride == play.spec.train:
                assert set(counts.values()) == {1}
            left, episode = left - count, episode + 1


@given(plays(), st.integers(1, 80))
def test_weights_update_is_that_of_the_first_trained_step(play: Play, steps: int) -> None:
    """The version is the time here, and time = steps of the episodes before + k."""
    rows, _ = run(play, steps)
    for row in rows:
        env, episode, k0 = (int(x) for x in row["observation"][int(row["first"])])
        before = sum(play.length(env, e) for e in range(episode))
        assert row["weights_update"] == before + k0 + play.spec.burn_in - int(row["first"])


@given(plays())
def test_an_episode_that_ends_on_a_block_sends_no_empty_window(play: Play) -> None:
    blocks = 3
    exact = Play(play.spec, play.spec.train, [[blocks * play.spec.train]] * len(play.lengths))
    rows, episodes = run(exact, 2 * blocks * play.spec.train)
    assert episodes == [2] * len(play.lengths)
    assert len(rows) == 2 * blocks * len(play.lengths)
    assert (rows["last"] == play.spec.steps).all()


def test_begin_forgets_an_open_window() -> None:
    spec = WindowSpec(OBS_DIM, ACTION_DIM, HIDDEN, burn_in=2, train=4)
    builder = WindowBuilder(spec, 4, envs=1, capacity=1)
    zeros, no = np.zeros((1, 3), np.float32), np.zeros(1, np.bool_)
    seen = np.zeros((1, 1), np.bool_)
    builder.begin(0, name(0, 0, 0), missing=False)
    builder.add(zeros, zeros, 0, Transition(zeros[:, 0], zeros, seen, no, no, zeros[:, :0]))
    assert builder.open
    builder.begin(0, name(0, 1, 0), missing=False)
    assert not builder.open
    builder.cut()
    assert builder.count == 0


def test_a_step_that_must_not_be_trusted_is_in_no_window() -> None:
    """Also where it alone would fill a trained block."""
    spec = WindowSpec(OBS_DIM, ACTION_DIM, HIDDEN, burn_in=0, train=1)
    builder = WindowBuilder(spec, 1, envs=1, capacity=2)
    zeros, no, seen = np.zeros((1, 3), np.float32), np.zeros(1, np.bool_), np.zeros((1, 1), np.bool_)
    builder.begin(0, name(0, 0, 0), missing=False)
    for k in (1, 2):
        if k == 2:
            builder.end_before(0)
        builder.add(zeros, zeros, 0, Transition(zeros[:, 0], name(0, 0, k)[None], seen, no, no, zeros[:, :0]))
    builder.begin(0, name(0, 1, 0), missing=False)
    assert builder.take()["observation"][..., 2].tolist() == [[0, 1]]
