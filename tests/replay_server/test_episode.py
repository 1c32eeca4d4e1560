"""An episode's windows are found again among those of other environments, or not at all."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmc.common.window import Rows
from rmc.replay_server import episode
from rmc.replay_server.episode import find_episode
from rmc.replay_server.ring import Ring
from tests.replay_server.support import SPEC, make_rows, write_steps

ENVS = [(0, 1, 0), (0, 1, 1), (1, 1, 0), (0, 2, 0)]  # actor, epoch, env


def played(lengths: list[tuple[int, int]], stride: int) -> tuple[Rows, list[list[int]]]:
    """Windows of episodes in turn: of each (environment, windows); and the serials of every window's episode."""
    turns = [(env, episode, window) for episode, (env, count) in enumerate(lengths) for window in range(count)]
    turns.sort(key=lambda turn: _round(lengths, turn))
    rows = make_rows(len(turns))
    for row, (env, _, window) in zip(rows, turns, strict=True):
        row["actor"], row["epoch"], row["env"] = ENVS[env]
        row["episode_step"] = stride * window
    write_steps(rows, [episode for _, episode, _ in turns])
    chains = [
        [earlier for earlier, (_, e, w) in enumerate(turns) if e == chain and w <= window] for _, chain, window in turns
    ]
    return rows, chains


def _round(lengths: list[tuple[int, int]], turn: tuple[int, int, int]) -> int:
    """How many windows of its environment came before: an environment plays its episodes one after another."""
    env, episode, window = turn
    return sum(count for other, count in lengths[:episode] if other == env) + window


@settings(max_examples=100, deadline=None)
@given(
    lengths=st.lists(st.tuples(st.integers(0, len(ENVS) - 1), st.integers(1, 6)), min_size=1, max_size=12),
    stride=st.integers(1, SPEC.train),
    capacity=st.integers(4, 60),
    chunk=st.integers(1, 9),
)
def test_every_episode_is_found_whole_or_not_at_all(
    lengths: list[tuple[int, int]], stride: int, capacity: int, chunk: int
) -> None:
    rows, chains = played(lengths, stride)
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(episode, "CHUNK", chunk)
        ring = Ring(Path(folder) / "ring", SPEC, capacity)
        ring.write(rows)
        ring.commit(len(rows))
        for serial, chain in enumerate(chains):
            slots = find_episode(ring, serial, most=6)
            whole = chain[0] >= ring.progress.valid_from
            assert (None if slots is None else ring.rows["serial"][slots].tolist()) == (chain if whole else None)


def ring_of(folder: Path, episode_steps: list[int], seen: float = 1.0) -> Ring:
    """An episode begins at each step 0; ``seen`` 0 leaves no frame."""
    ring, rows = Ring(folder / "ring", SPEC, 100), make_rows(len(episode_steps))
    rows["episode_step"] = episode_steps
    write_steps(rows, np.cumsum(np.array(episode_steps) == 0).tolist())
    rows["observation"] *= seen
    ring.write(rows)
    ring.commit(len(rows))
    return ring


@pytest.mark.parametrize(
    ("steps", "why"),
    [
        ([0, 4, 12], "a window between them was refused"),
        ([4, 8, 12], "its start was refused"),
        ([0, 4, 8, 12, 16, 20], "longer than asked for"),
        ([0, 4, 8, 0, 4, 12], "the windows before are of another episode"),
    ],
)
def test_what_is_not_whole_is_not_found(tmp_path: Path, steps: list[int], why: str) -> None:
    ring = ring_of(tmp_path, steps)
    assert find_episode(ring, len(steps) - 1, most=5) is None, why


@pytest.mark.parametrize("seen", [1.0, 0.0])
def test_the_episode_before_is_not_taken_for_the_start_that_is_gone(tmp_path: Path, seen: float) -> None:
    """It ended at the very step at which the windows of the later one that are left begin."""
    ring = ring_of(tmp_path, [0, 0, 4], seen)
    ring.forget(np.array([1]))
    assert find_episode(ring, 2, most=5) is None


def test_who_is_not_there_has_no_episode(tmp_path: Path) -> None:
    ring = ring_of(tmp_path, [0, 4])
    assert find_episode(ring, 2, most=5) is None
    assert find_episode(ring, -1, most=5) is None


def test_it_does_not_look_for_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episode, "FARTHEST", 2)
    ring = ring_of(tmp_path, [0, 4, 8, 12])
    assert find_episode(ring, 3, most=5) is None
    slots = find_episode(ring, 2, most=5)
    assert np.array_equal(slots, [0, 1, 2])
