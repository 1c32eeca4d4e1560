"""The ledger has what the ring had, and says what it lacks."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rmc.common.env.config import EnvConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.presets import debug
from rmc.replay_server.recovery import ReplayStore, open_store
from tests.faults.judge import Judgement, judge_rows
from tests.faults.ledger import Ledger

CAPACITY, ENTRY = 100, 10  # windows


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    config, run = debug(EnvConfig("Pendulum-v1")), RunFolder(tmp_path)
    run.write_config(dataclasses.replace(config, replay=dataclasses.replace(config.replay, capacity=CAPACITY)))
    return run


@pytest.fixture
def store(run: RunFolder) -> Iterator[ReplayStore]:
    store = open_store(run.path / "replay", run.config().window_spec(), CAPACITY, 0.0)
    yield store
    store.close()


def take_in(store: ReplayStore, seq: int, ledger: Ledger | None = None) -> None:
    """An entry of windows that follow each other step by step; a ledger looks amid it."""
    rows = np.zeros(ENTRY, store.ring.spec.dtype)
    rows["epoch"], rows["seq"], rows["k"], rows["new_steps"] = 1, seq, range(ENTRY), 1
    rows["episode_step"] = range((seq - 1) * ENTRY, seq * ENTRY)
    store.ring.write(rows)
    if ledger is not None:
        ledger.look()
    store.ring.commit(ENTRY)


def test_it_has_all_windows_of_a_ring_that_wraps(run: RunFolder, store: ReplayStore) -> None:
    ledger = Ledger(run)
    for seq in range(1, 31):
        take_in(store, seq, ledger)
    ledger.look()
    assert judge_rows(ledger.rows(), {(0, 1): 30}, full=False) == Judgement(30 * ENTRY, 0, 0, 0)
    assert (ledger.missed, ledger.disordered()) == (0, 0)
    assert judge_rows(ledger.rows(), {(0, 1): 31}, full=False).lost == 1


def test_it_says_what_went_before_it_looked(run: RunFolder, store: ReplayStore) -> None:
    ledger = Ledger(run)
    for seq in range(1, 13):
        take_in(store, seq)
    ledger.look()
    assert ledger.missed == 2 * ENTRY


def test_what_comes_again_later_is_out_of_order(run: RunFolder, store: ReplayStore) -> None:
    ledger = Ledger(run)
    for seq in (1, 2, 1):
        take_in(store, seq)
    ledger.look()
    assert ledger.disordered() == 1
    assert judge_rows(ledger.rows(), {}, full=False).duplicated == ENTRY


def test_a_window_that_it_damages_is_no_longer_whole(run: RunFolder, store: ReplayStore) -> None:
    ledger = Ledger(run)
    assert ledger.damage(0.5) is None
    take_in(store, 1)
    ledger.look()
    serial = ledger.damage(0.5)
    assert serial is not None
    slots = np.arange(ENTRY)
    whole = store.ring.gather(slots, np.empty(ENTRY, store.ring.spec.dtype))
    assert np.flatnonzero(~whole).tolist() == [serial]
