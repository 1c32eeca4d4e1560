"""How a replay server begins: an epoch of its own, and the counters and windows that it goes on from."""

import logging

from rmc.common.bus.protocol import Bus
from rmc.common.window import WindowSpec
from rmc.replay_server.commit_record import Progress, decode_published
from rmc.replay_server.recovery import ReplayStore, valid_leaves, warn_of_torn_rows

log = logging.getLogger(__name__)


def take_over(store: ReplayStore, bus: Bus, name: str, spec: WindowSpec, replay_ratio: float, warmup_steps: int) -> int:
    """Begin an epoch of the role ``name`` on this store, durably; its number. Raises BusUnavailable."""
    epoch, published = _take_epoch(bus, name, spec, store.ring.progress.replay_epoch)
    if published is not None:
        _go_on_from(store, published)
    if store.tree.total == 0.0:
        _begin_empty(store.ring.progress, name)
    else:
        warn_of_torn_rows(store)
    store.ring.progress.replay_epoch = epoch
    _hold_ratio(store.ring.progress, replay_ratio, warmup_steps)
    store.ring.commit()
    store.ring.flush_commit()  # by its epoch this ring is known again after a power cut, too
    return epoch


def _take_epoch(bus: Bus, name: str, spec: WindowSpec, at_least: int) -> tuple[int, Progress | None]:
    """It, and what was published by then: the server before us commits nothing after that."""
    epoch = bus.take_epoch(name, at_least)
    while (newest := _read_published(bus, name, spec)) is not None and newest.replay_epoch >= epoch:  # in another Redis
        epoch = bus.take_epoch(name, newest.replay_epoch)
    return epoch, newest


def _read_published(bus: Bus, name: str, spec: WindowSpec) -> Progress | None:
    published = bus.progress(name)
    newest = decode_published(published, spec) if published else None
    if published and newest is None:
        log.warning("%s: the counters that were published are damaged; going on from the ring's", name)
    return newest


def _go_on_from(store: ReplayStore, published: Progress) -> None:
    """Of counters that were published and those of this ring, take the later.

    Published by a server that never wrote here: that one's ring is lost, and what this one holds is older and
    goes, for no serial may name two windows. By one that did: a power cut has lost the end of this ring.
    """
    another = published.replay_epoch > store.ring.progress.replay_epoch
    if not another and not published.is_after(store.ring.progress):
        return
    if another:
        published.valid_from = published.next_serial
    store.ring.progress = published
    store.tree.rebuild(valid_leaves(store))


def _begin_empty(progress: Progress, name: str) -> None:
    """The counters go on, and warm-up is collected once more before the next draw."""
    progress.valid_from = progress.next_serial
    progress.begun_env_steps = progress.env_steps
    progress.begun_drawn_steps = progress.drawn_steps + progress.elsewhere_steps
    if progress.next_serial:
        log.warning(
            "%s: the ring of %d windows is lost; begins empty at agent step %d",
            name, progress.next_serial, progress.env_steps,
        )  # fmt: skip


def _hold_ratio(progress: Progress, replay_ratio: float, warmup_steps: int) -> None:
    """A ratio other than before counts from here: nothing is owed for what was, and nobody waits for it."""
    if progress.replay_ratio != replay_ratio:
        progress.replay_ratio = replay_ratio
        progress.begun_drawn_steps = progress.drawn_steps + progress.elsewhere_steps
        progress.begun_env_steps = progress.env_steps - min(progress.inserted, warmup_steps)
