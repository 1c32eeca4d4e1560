"""The ring: what was committed is there, whole and once, wherever the process was killed."""

import dataclasses
import math
import shutil
import struct
import tempfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmc.common.bus.protocol import EntryId
from rmc.common.errors import ConfigError
from rmc.common.replay import ObservationStatistics
from rmc.common.window import WindowSpec, fingerprint
from rmc.replay_server import former_rows
from rmc.replay_server.commit_record import (
    Progress,
    RecordPair,
    StreamPosition,
    decode_progress,
    decode_published,
    record_bytes,
)
from rmc.replay_server.ring import Ring
from tests.replay_server.support import SPEC, make_rows

RECORDS_START = 4096


def marks(ring: Ring) -> list[int]:
    """The marks of all windows that may be sampled, by serial, after checking that each is whole."""
    serials = np.arange(ring.progress.valid_from, ring.progress.next_serial)
    rows = np.zeros(len(serials), SPEC.dtype)
    assert ring.gather(serials % ring.capacity, rows).all()
    assert rows["serial"].tolist() == serials.tolist()
    for row in rows:  # a window's contents follow from its mark
        (original,) = make_rows(1, int(row["reward"][0]))
        original["serial"], original["checksum"] = row["serial"], row["checksum"]
        assert row.tobytes() == original.tobytes()
    return [int(mark) for mark in rows["reward"][:, 0]]


@settings(max_examples=80, deadline=None)
@given(
    capacity=st.integers(1, 12),
    appends=st.lists(
        st.tuples(st.integers(0, 15), st.sampled_from(["whole", "after rows", "torn record"])), max_size=12
    ),
)
def test_killed_anywhere(capacity: int, appends: list[tuple[int, str]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path, committed = Path(folder) / "ring", 0
        ring = Ring(path, SPEC, capacity)
        for count, fate in appends:
            before = ring.progress.valid_from
            ring.write(make_rows(count, committed))
            if fate != "after rows":
                ring.commit(count)
            if fate == "torn record":
                tear_newest_record(path)
            if fate == "whole":
                committed += count
            else:
                ring = Ring(path, SPEC, capacity)  # nothing of the old one was flushed or closed
            progress = ring.progress
            assert progress.next_serial == committed
            assert progress.valid_from <= max(
                before, min(committed, committed + count - capacity), committed - capacity
            )
            assert marks(ring) == list(range(progress.valid_from, committed))
        if all(fate == "whole" for _, fate in appends):
            assert ring.progress.windows == min(capacity, committed)


def tear_newest_record(path: Path) -> None:
    """As if the process had been killed amid the record's last bytes."""
    raw = bytearray(path.read_bytes())
    half = record_bytes(SPEC)
    newest = max(range(2), key=lambda copy: struct.unpack_from("<Q", raw, RECORDS_START + copy * half)[0])
    raw[RECORDS_START + newest * half + 30] ^= 0xFF
    with path.open("r+b") as file:  # in place: the map of the living ring sees it, too
        file.write(raw)


@settings(max_examples=50, deadline=None)
@given(
    numbers=st.lists(st.integers(0, 2**62), min_size=8, max_size=8),
    streams=st.dictionaries(
        st.integers(0, 2**31 - 1),
        st.tuples(st.integers(1, 2**31), st.integers(0, 2**62), st.integers(0, 2**62)),
        max_size=20,
    ),
)
def test_progress_survives_the_round_trip(numbers: list[int], streams: dict[int, tuple[int, int, int]]) -> None:
    *counters, observations = numbers
    progress = Progress(
        ObservationStatistics(np.array([observations]), np.arange(3.0), np.ones(3)), *counters, max_priority=3.5
    )
    progress.replay_ratio = 0.1
    progress.streams = {actor: StreamPosition(EntryId(e, s), n) for actor, (e, s, n) in streams.items()}
    again = decode_progress(progress.encode(), SPEC)
    assert again.encode() == progress.encode()
    assert again.streams == progress.streams
    assert again.observed.total.tolist() == [0.0, 1.0, 2.0]
    assert again.replay_ratio == 0.1
    assert decode_progress(progress.encode()[:-8], SPEC).replay_ratio == 0.0  # as of config format 1


@pytest.mark.parametrize("obs_dim", [1, 3, 248, 249, 376])
def test_most_streams_and_the_ratio_fit_into_a_record(obs_dim: int) -> None:
    spec = dataclasses.replace(SPEC, obs_dim=obs_dim)
    progress = Progress(ObservationStatistics.none(spec), replay_ratio=4.0)
    progress.streams = {actor: StreamPosition(EntryId(1, 0), 0) for actor in range(4096)}
    records = RecordPair(np.zeros(2 * record_bytes(spec), np.uint8), spec)
    records.write(progress)
    read = records.read()
    assert read is not None
    assert (len(read.streams), read.replay_ratio) == (4096, 4.0)


@pytest.mark.parametrize("commits", [3, 4])
def test_after_a_restart_the_older_record_is_replaced(commits: int) -> None:
    """Were it the newer one, a crash before the next commit would take the ring back by some."""
    region = np.zeros(2 * record_bytes(SPEC), np.uint8)
    records = RecordPair(region, SPEC)
    for number in range(1, commits + 1):
        records.write(Progress(NOTHING, draws=number))
    for number in (commits, commits + 1):
        again = RecordPair(region, SPEC)
        read = again.read()
        assert read is not None
        assert read.draws == number
        again.write(Progress(NOTHING, draws=number + 1))


def test_too_many_streams() -> None:
    progress = Progress(NOTHING)
    progress.streams = {actor: StreamPosition(EntryId(1, 0), 0) for actor in range(4097)}
    with pytest.raises(ConfigError, match="--actors=4097"):
        progress.encode()


def test_another_layout_or_capacity_is_named(tmp_path: Path) -> None:
    Ring(tmp_path / "ring", SPEC, 10)
    with pytest.raises(ConfigError, match=r"--capacity=11: the ring in .* has 10"):
        Ring(tmp_path / "ring", SPEC, 11)
    other = WindowSpec(obs_dim=4, action_dim=2, state=4, burn_in=2, train=4)
    with pytest.raises(ConfigError, match=f"layout {SPEC.fingerprint}, this run's of {other.fingerprint}"):
        Ring(tmp_path / "ring", other, 10)


@pytest.mark.parametrize("damage", ["identity", "records", "short"])
def test_damage_is_named(tmp_path: Path, damage: str) -> None:
    Ring(tmp_path / "ring", SPEC, 10)
    raw = bytearray((tmp_path / "ring").read_bytes())
    if damage == "identity":
        raw[3] ^= 1
    if damage == "records":
        size = 2 * record_bytes(SPEC)
        raw[RECORDS_START : RECORDS_START + size] = bytes(size)
    (tmp_path / "ring").write_bytes(raw[:-1] if damage == "short" else raw)
    with pytest.raises(ConfigError, match=r"--run-dir=.*delete"):
        Ring(tmp_path / "ring", SPEC, 10)


def test_no_space_is_named_and_nothing_is_left(tmp_path: Path) -> None:
    too_many = 2 * shutil.disk_usage(tmp_path).total // SPEC.dtype.itemsize
    with pytest.raises(ConfigError, match=r"--capacity=.*GiB"):
        Ring(tmp_path / "ring", SPEC, too_many)
    assert list(tmp_path.iterdir()) == []


def test_space_is_taken_at_once(tmp_path: Path) -> None:
    Ring(tmp_path / "ring", SPEC, 5000)
    status = (tmp_path / "ring").stat()
    assert status.st_blocks * 512 >= status.st_size > 5000 * SPEC.dtype.itemsize


NOTHING = ObservationStatistics.none(SPEC)
ALL, FIVE = dataclasses.replace(SPEC, missing=3, privileged=2), dataclasses.replace(SPEC, obs_dim=5)


def test_counts_by_number_survive_the_round_trip_and_fit_into_a_record() -> None:
    assert (ALL.statistics, ALL.counts) == (5, 5)
    streams = {actor: StreamPosition(EntryId(1, 0), 0) for actor in range(4096)}
    for dims in (5, 165, 166, 376):
        spec = dataclasses.replace(ALL, obs_dim=dims - 2, missing=dims - 2)
        observed = ObservationStatistics(np.arange(dims), np.ones(dims), np.ones(dims))
        progress = Progress(observed, streams=streams, replay_ratio=4.0)
        records = RecordPair(np.zeros(2 * record_bytes(spec), np.uint8), spec)
        records.write(progress)
        read = records.read()
        assert read is not None
        assert read.encode() == progress.encode()
        assert read.observed.count.tolist() == list(range(dims))
    by_number, one_count = (Progress(ObservationStatistics.none(spec)).publish() for spec in (ALL, FIVE))
    assert decode_published(by_number, ALL) is not None
    assert decode_published(by_number, FIVE) is None  # of other windows
    assert decode_published(one_count, ALL) is None


@pytest.mark.parametrize(
    "senseless",
    [
        {"next_serial": -7}, {"replay_epoch": 2**63 - 1}, {"max_priority": math.nan}, {"max_priority": 0.0},
        {"valid_from": 9, "next_serial": 8}, {"observed": dataclasses.replace(NOTHING, count=np.array([-1]))},
    ],
)  # fmt: skip
def test_counters_that_no_ring_says_are_damaged(senseless: dict[str, Any]) -> None:
    """Whoever can write to the run's Redis can give them a right checksum."""
    assert decode_published(Progress(NOTHING, next_serial=8).publish(), SPEC) is not None
    assert decode_published(Progress(**{"observed": NOTHING} | senseless).publish(), SPEC) is None


def test_a_negative_number_of_streams_is_damaged() -> None:
    payload = bytearray(Progress(NOTHING).encode())
    streams = len(payload) - 6 * 8 - 8 - 8  # before the sums and the ratio
    assert struct.unpack_from("<q", payload, streams) == (0,)
    struct.pack_into("<q", payload, streams, -1)
    del payload[-4 * 8 :]  # as long as so many streams make it
    assert decode_published(struct.pack("<I", zlib.crc32(payload)) + payload, SPEC) is None


@pytest.mark.parametrize("missing", ["missing", "blank"])
def test_a_ring_of_an_older_version_is_rewritten(tmp_path: Path, missing: str) -> None:
    """Its windows, counters and priorities' slots are what they were; damaged, it is refused as ever."""
    path, capacity = tmp_path / "ring", 5
    write_former_ring(path, missing, make_rows(8, 1), capacity)
    (tmp_path / "ring.tmp").write_bytes(b"of a start that was killed")
    before = path.read_bytes()
    for _ in range(2):
        ring = Ring(path, SPEC, capacity)
        assert marks(ring) == [4, 5, 6, 7, 8]
        assert (ring.progress.env_steps, ring.progress.next_serial) == (77, 8)
        assert not (tmp_path / "ring.tmp").exists()
    for spec in (ALL, dataclasses.replace(SPEC, privileged=1)):
        path.write_bytes(before)
        with pytest.raises(ConfigError, match=f"this run's of {spec.fingerprint}; use a new folder"):
            Ring(path, spec, capacity)
    path.write_bytes(before[:-1])
    with pytest.raises(ConfigError, match="cut short"):
        Ring(path, SPEC, capacity)


def test_what_an_older_ring_holds_damaged_is_not_drawn(tmp_path: Path) -> None:
    rows = make_rows(4)
    rows["observation"][1, 0, 0], rows["last"][2] = np.nan, 99
    write_former_ring(tmp_path / "ring", "missing", rows, 4)
    ring, out = Ring(tmp_path / "ring", SPEC, 4), np.zeros(4, SPEC.dtype)
    assert ring.gather(np.arange(4), out).tolist() == [True, False, False, True]


def test_an_older_ring_without_room_to_rewrite_it_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_former_ring(tmp_path / "ring", "missing", make_rows(3), 5)
    before = (tmp_path / "ring").read_bytes()
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10, 10, 0))  # type: ignore[attr-defined]
    with pytest.raises(
        ConfigError,
        match=r"--run-dir=.*older version, and rewriting it needs .* GiB in .*; free that much and start again$",
    ):
        Ring(tmp_path / "ring", SPEC, 5)
    assert (tmp_path / "ring").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["ring"]


def write_former_ring(path: Path, missing: str, rows: np.ndarray, capacity: int) -> None:
    """As the versions before checksums wrote it: these rows, the oldest first, of which the last are there."""
    dtype = former_rows._former_dtype(SPEC, missing)
    kept = np.zeros(capacity, dtype)
    for serial, row in enumerate(rows):
        slot = kept[serial % capacity]
        for name in dtype.names or ():
            slot[name] = row["missing"][:, 0] if name == missing else row[name]
        slot["serial"] = serial
    identity = struct.pack("<8s16sQQ", b"RMCRING3", fingerprint(SPEC, dtype).encode(), capacity, dtype.itemsize)
    identity += struct.pack("<I", zlib.crc32(identity))
    records = np.zeros(2 * record_bytes(SPEC), np.uint8)
    progress = Progress(NOTHING, next_serial=len(rows), valid_from=max(0, len(rows) - capacity), env_steps=77)
    RecordPair(records, SPEC).write(progress)
    path.write_bytes(identity.ljust(RECORDS_START, b"\0") + records.tobytes() + kept.tobytes())


def test_a_whole_row_that_is_not_its_slots_window_is_none(tmp_path: Path) -> None:
    """As after a write that went elsewhere, or never reached the disk: its checksum is right."""
    ring, out = Ring(tmp_path / "ring", SPEC, 4), np.zeros(4, SPEC.dtype)
    for first in (0, 4):
        before = ring.rows.copy()
        ring.write(make_rows(4, first))
        ring.commit(4)
    ring.rows[1] = ring.rows[0]
    ring.rows[2] = before[2]
    assert ring.gather(np.arange(4), out).tolist() == [True, False, False, True]
