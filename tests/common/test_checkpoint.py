"""Checkpoints are whole or absent, and damage is seen."""

import hashlib
import json
import os
import re
import shutil
from contextlib import suppress
from pathlib import Path

import pytest

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import CheckpointError, ConfigError
from tests.holding import held_for_a_moment

FILES = {"state": b"\x00" * 100, "progress.json": b"{}"}
OUTSIDE = [
    "../../escaped", "../escaped", "/proc/self/escaped", "sub/escaped", "./escaped", "escaped/", "", ".", "..",
    "nul\0", "\ud800", "manifest.json",
]  # fmt: skip


def test_round_trip_and_pruning(tmp_path):
    folder = CheckpointFolder(tmp_path / "checkpoints", keep=2)
    folder.lock()
    for number in (10, 20, 30):
        folder.save(number, {**FILES, "state": bytes([number])})
    assert folder.numbers() == [20, 30]
    assert folder.latest() == (30, {"state": b"\x1e", "progress.json": b"{}"})


def test_best_is_kept_and_only_beaten_by_better(tmp_path):
    folder = CheckpointFolder(tmp_path, keep=1)
    folder.save(1, FILES)
    folder.mark_best(1, 5.0)
    folder.save(2, FILES)
    folder.mark_best(2, 4.0)
    folder.save(3, FILES)
    assert (folder.best(), folder.numbers()) == (1, [1, 3])


def test_one_that_is_dropped_as_it_is_marked_leaves_the_best_before(tmp_path):
    """The learner drops, the launcher marks: in two processes, neither waits for the other."""
    folder = CheckpointFolder(tmp_path)
    for number, score in ((1, 100.0), (2, 200.0)):
        folder.save(number, FILES)
        folder.mark_best(number, score)
    shutil.rmtree(folder.path(2))
    assert folder.best() == 1
    folder.keep = 1
    folder.save(3, FILES)
    folder.mark_best(3, -5.0)
    assert (folder.best(), folder.numbers()) == (1, [1, 3])


@pytest.mark.parametrize("damage", ["flip", "truncate", "manifest", "missing"])
def test_damage_is_found_and_an_older_one_used(tmp_path, damage):
    folder = CheckpointFolder(tmp_path)
    folder.save(1, FILES)
    folder.save(2, FILES)
    target = folder.path(2) / ("manifest.json" if damage == "manifest" else "state")
    content = bytearray(target.read_bytes())
    if damage == "missing":
        target.unlink()
    else:
        content[len(content) // 2] ^= 1
        target.write_bytes(content[:-1] if damage == "truncate" else content)
    with pytest.raises(CheckpointError, match="000000002"):
        folder.load(2)
    checkpoint = folder.latest()
    assert checkpoint is not None
    assert checkpoint[0] == 1


@pytest.mark.parametrize("next_number", [15, 20, 40])
def test_after_a_fall_back_damaged_ones_are_not_counted_among_the_kept(tmp_path, next_number):
    """Neither that newer ones are there, nor that they were passed over, costs the run its newest whole one."""
    for number in (10, 20, 30):
        CheckpointFolder(tmp_path).save(number, FILES)
    for number in (20, 30):
        (tmp_path / f"{number:09d}" / "state").write_bytes(b"damaged")
    folder = CheckpointFolder(tmp_path, keep=2)
    checkpoint = folder.latest()
    assert checkpoint is not None
    assert checkpoint[0] == 10
    folder.save(next_number, FILES)
    assert folder.numbers() == [10, next_number]
    assert folder.load(next_number) == FILES


def test_the_one_just_written_is_kept_where_newer_ones_lie(tmp_path):
    CheckpointFolder(tmp_path).save(20, FILES)
    folder = CheckpointFolder(tmp_path, keep=1)
    folder.save(15, FILES)
    assert folder.load(15) == FILES


def test_every_byte_of_a_manifest_counts(tmp_path):
    folder = CheckpointFolder(tmp_path)
    folder.save(1, FILES)
    manifest = folder.path(1) / "manifest.json"
    whole = manifest.read_bytes()
    for place in range(len(whole)):
        content = bytearray(whole)
        content[place] ^= 1 << place % 8
        manifest.write_bytes(content)
        with pytest.raises(CheckpointError, match="000000001"):
            folder.load(1)
    manifest.write_bytes(whole)
    assert folder.load(1) == FILES


def test_one_without_room_leaves_nothing(tmp_path):
    folder = CheckpointFolder(tmp_path / "c")
    folder.save(1, FILES)
    with pytest.raises(CheckpointError, match=r"000000002 cannot be written \(File name too long\)") as raised:
        folder.save(2, {**FILES, "x" * 300: b""})  # the third of three
    assert raised.value.reason == "File name too long"
    assert sorted(path.name for path in folder.folder.iterdir()) == ["000000001"]


def test_the_writers_epoch_is_kept(tmp_path):
    folder = CheckpointFolder(tmp_path)
    assert folder.last_epoch() == 0
    folder.note_epoch(7)
    folder.note_epoch(8)
    assert CheckpointFolder(tmp_path).last_epoch() == 8
    (tmp_path / "epoch").write_bytes(b"")
    assert folder.last_epoch() == 0
    folder.folder = tmp_path / "away"
    folder.note_epoch(9)  # no room there; nothing is raised


def test_a_half_written_checkpoint_is_not_seen(tmp_path):
    folder = CheckpointFolder(tmp_path)
    (tmp_path / ".tmp-000000005").mkdir()
    folder.lock()
    assert folder.numbers() == []
    assert not (tmp_path / ".tmp-000000005").exists()


def test_it_is_on_the_disk_before_it_has_its_name_and_then_its_name_is(tmp_path, monkeypatch):
    """Else after a power cut there is one that is not whole, or none though an older one was dropped for it."""
    folder, synchronised, fsync = CheckpointFolder(tmp_path), [], os.fsync

    def watched(handle: int) -> None:
        fsync(handle)
        synchronised.append((Path(f"/proc/self/fd/{handle}").readlink().name, folder.path(1).exists()))

    monkeypatch.setattr(os, "fsync", watched)
    folder.save(1, FILES)
    before = [(name, False) for name in (*FILES, "manifest.json", ".tmp-000000001")]
    assert synchronised == [*before, (tmp_path.name, True)]


def test_two_writers_exclude_each_other(tmp_path, monkeypatch):
    monkeypatch.setattr("rmc.common.process.file_lock.LOCK_SECONDS", 0.2)
    first, second = CheckpointFolder(tmp_path / "c"), CheckpointFolder(tmp_path / "c")
    first.lock()
    with pytest.raises(ConfigError, match="another process"):
        second.lock()
    first.unlock()
    second.lock()


def test_a_writer_that_is_about_to_end_is_waited_for(tmp_path):
    folder = CheckpointFolder(tmp_path)
    with held_for_a_moment(tmp_path / ".lock"):
        folder.lock()
    folder.unlock()


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_manifest_cannot_name_a_file_outside(tmp_path, name):
    folder = CheckpointFolder(tmp_path / "c")
    folder.save(1, FILES)
    files = {**FILES, name: b"secret"}
    for place in (folder.path(1) / name, folder.path(1) / Path(name).name):  # it is there, whichever is read
        with suppress(OSError, ValueError):
            place.write_bytes(b"secret")
    (folder.path(1) / "manifest.json").write_bytes(manifest_of(1, files))  # only the name is wrong
    with pytest.raises(CheckpointError, match=f"file name {re.escape(repr(name))} refused"):
        folder.load(1)
    assert folder.latest() is None


@pytest.mark.parametrize("name", OUTSIDE)
def test_nothing_is_saved_outside(tmp_path, name):
    folder = CheckpointFolder(tmp_path / "c")
    folder.save(1, FILES)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(CheckpointError, match=f"file name {re.escape(repr(name))} refused"):
        folder.save(2, {**FILES, name: b"secret"})
    assert sorted(tmp_path.rglob("*")) == before


def test_a_manifest_made_by_hand_is_one_that_is_taken(tmp_path):
    folder = CheckpointFolder(tmp_path)
    folder.save(1, FILES)
    (folder.path(1) / "third").write_bytes(b"3")
    (folder.path(1) / "manifest.json").write_bytes(manifest_of(1, {**FILES, "third": b"3"}))
    assert folder.load(1) == {**FILES, "third": b"3"}


def manifest_of(number: int, files: dict[str, bytes]) -> bytes:
    """As it is written, to the byte."""
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    return json.dumps({"update": number, "sha256": digests}, indent=1).encode()


@pytest.mark.parametrize(("noted", "granted"), [(2.0, 6.0), (0.5, 2.6), (float("nan"), 2.6), (float("inf"), 2.6)])
def test_the_next_save_may_take_three_times_the_last_one(tmp_path, noted, granted):
    assert CheckpointFolder(tmp_path / "none").patience(2.6) == 2.6
    CheckpointFolder(tmp_path).note_save(noted)
    assert CheckpointFolder(tmp_path).patience(2.6) == granted


def test_a_number_that_is_saved_again_is_there_whatever_is_removed(tmp_path, monkeypatch):
    """A kill then leaves the old one or the new one."""
    folder, remove = CheckpointFolder(tmp_path), shutil.rmtree
    folder.save(1, FILES)

    def removed(path, **options):
        remove(path, **options)
        assert folder.load(1)

    monkeypatch.setattr("rmc.common.checkpoint.shutil.rmtree", removed)
    folder.save(1, {"state": b"new"})
    assert folder.load(1) == {"state": b"new"}
    assert os.listdir(tmp_path) == ["000000001"]


def test_a_save_that_fails_or_is_killed_between_its_renames_leaves_the_old_one(tmp_path, monkeypatch):
    folder, rename = CheckpointFolder(tmp_path), Path.rename
    folder.save(1, FILES)

    def refuse(path, target):
        if path.name == ".tmp-000000001":
            raise OSError(5, "Input/output error")
        return rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", refuse)
        with pytest.raises(CheckpointError):
            folder.save(1, {"state": b"new"})
    assert folder.load(1) == FILES
    folder.path(1).rename(tmp_path / ".tmp-000000001.old")
    folder.lock()
    assert folder.load(1) == FILES


def test_a_best_one_that_is_gone_is_none(tmp_path):
    folder = CheckpointFolder(tmp_path)
    for number in (1, 2):
        folder.save(number, FILES)
    folder.mark_best(2, 5.0)
    shutil.rmtree(folder.path(2))
    assert folder.best() is None
    folder.mark_best(1, 4.0)
    assert folder.best() == 1
