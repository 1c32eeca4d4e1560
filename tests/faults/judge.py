"""What a ring holds against what was acknowledged: nothing lost but by age, nothing there twice.

An actor numbers the entries of its life, an entry its windows, and the windows of an environment follow step on step:
so a gap shows what was lost, and an origin (actor, epoch, seq, k) that stands twice what was doubled.
"""

import dataclasses
from contextlib import closing
from pathlib import Path

import numpy as np

from rmc.common.bus.protocol import EntryId
from rmc.common.window import Rows
from rmc.deploy.run.folder import RunFolder
from rmc.replay_server.recovery import ReplayStore, open_store

Acks = dict[tuple[int, int], int]


@dataclasses.dataclass(frozen=True)
class Judgement:
    """Windows of a ring that no process has open."""

    acknowledged: int
    lost: int
    duplicated: int
    acted_on_older: int  # windows of older weights than the same environment's before; only one learner's can be told

    @property
    def sound(self) -> bool:
        """Whether nothing was lost or doubled."""
        return not (self.lost or self.duplicated)


def opened(folder: Path) -> closing[ReplayStore]:
    """The ring of a run that nobody trains. Raises ConfigError."""
    run = RunFolder(folder)
    config = run.config()
    return closing(
        open_store(run.path / "replay", config.window_spec(), config.replay.capacity, config.replay.priority_exponent)
    )


def judge(folder: Path, acks: Acks) -> Judgement:
    """``acks``: the largest number of an entry that was acknowledged, by actor and epoch. Raises ConfigError."""
    with opened(folder) as store:
        return judge_rows(rows_of(store), acks, full=store.ring.progress.valid_from > 0)


def rows_of(store: ReplayStore) -> Rows:
    """A ring's windows in the order of their serials."""
    progress = store.ring.progress
    rows: Rows = store.ring.rows[np.arange(progress.valid_from, progress.next_serial) % store.ring.capacity]
    return rows


def judge_rows(rows: Rows, acks: Acks, full: bool) -> Judgement:
    """Of (n,) windows in the order of their serials; ``full``: older ones are gone by age."""
    lost = sum(_lost(_of(rows, *life), acks.get(life, 0), full) for life in _lives(rows) | set(acks))
    older = sum(_older(_of(rows, *life)) for life in _lives(rows))
    return Judgement(int(rows["serial"][-1]) + 1 if len(rows) else 0, lost, _doubled(rows), older)


def _lives(rows: Rows) -> set[tuple[int, int]]:
    return {(actor, epoch) for actor, epoch in rows[["actor", "epoch"]].tolist()}


def _of(rows: Rows, actor: int, epoch: int) -> Rows:
    """A life's windows, as they were sent."""
    own = rows[(rows["actor"] == actor) & (rows["epoch"] == epoch)]
    ordered: Rows = own[np.lexsort((own["k"], own["seq"]))]
    return ordered


def _lost(own: Rows, acked: int, full: bool) -> int:
    """Entries, windows and steps that are missing between others or before ``acked``; age takes from the front."""
    if not len(own):
        return 0 if full else acked
    seqs = np.unique(own["seq"])
    first = int(seqs[0]) if full else 1
    missing = max(int(seqs[-1]), acked) - first + 1 - len(seqs)
    for seq in seqs[1:] if full else seqs:
        missing += int((np.diff(own["k"][own["seq"] == seq], prepend=-1) != 1).sum())
    return missing + sum(_gaps(own[own["env"] == env]) for env in np.unique(own["env"]))


def _doubled(rows: Rows) -> int:
    return len(rows) - len({tuple(row) for row in rows[["actor", "epoch", "seq", "k"]].tolist()})


def _older(own: Rows) -> int:
    """Windows of a life whose weights are older than those of the one before."""
    return sum(int((np.diff(own["weights_update"][own["env"] == env]) < 0).sum()) for env in np.unique(own["env"]))


def _gaps(windows: Rows) -> int:
    """Where an environment's windows do not follow each other, nor begin an episode."""
    reached = windows["episode_step"][:-1] + windows["new_steps"][:-1]
    follows = windows["episode_step"][1:] == reached
    return int((~follows & (windows["episode_step"][1:] != 0)).sum())


def newest(acks: Acks, actor: int, entry: EntryId) -> None:
    """Take an ack into ``acks``."""
    life = actor, entry.epoch
    acks[life] = max(acks.get(life, 0), entry.seq)
