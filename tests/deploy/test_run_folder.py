"""A run's secret is whole or absent, its owner's alone, and the same for all who ask at once."""

import errno
import os
import resource
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest

from common.errors import ConfigError
from deploy.run_folder import RunFolder


def test_a_secret_is_made_once(tmp_path: Path) -> None:
    first = RunFolder(tmp_path).secret()
    assert len(bytes.fromhex(first.decode())) == 32
    assert RunFolder(tmp_path).secret() == first
    assert stat.S_IMODE((tmp_path / "secret").stat().st_mode) == 0o600
    assert [path.name for path in tmp_path.iterdir()] == ["secret"]


def test_all_who_make_it_at_once_have_the_same(tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as pool:
        for number in range(50):
            folder, barrier = tmp_path / str(number), Barrier(8)
            folder.mkdir()

            def ask(_: int, folder: Path = folder, barrier: Barrier = barrier) -> bytes:
                barrier.wait()
                return RunFolder(folder).secret()

            assert len(set(pool.map(ask, range(8)))) == 1
            assert [path.name for path in folder.iterdir()] == ["secret"]


def test_it_is_on_the_disk_before_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synchronised, fsync = [], os.fsync

    def watched(handle: int) -> None:
        fsync(handle)
        synchronised.append((Path(f"/proc/self/fd/{handle}").read_bytes(), (tmp_path / "secret").exists()))

    monkeypatch.setattr(os, "fsync", watched)
    found = RunFolder(tmp_path).secret()
    assert synchronised == [(found + b"\n", False)]


def test_a_full_disk_leaves_none(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, hard))  # as a disk with room for 10 bytes
    try:
        with pytest.raises(OSError, match=os.strerror(errno.EFBIG)):
            RunFolder(tmp_path).secret()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []
    assert len(RunFolder(tmp_path).secret()) == 64


@pytest.mark.parametrize("left", ["", "\n", "ab" * 31 + "\n"])
def test_one_that_is_cut_short_is_an_error_and_can_be_removed(tmp_path: Path, left: str) -> None:
    (tmp_path / "secret").write_text(left)
    with pytest.raises(ConfigError, match=rf"secret='{tmp_path}/secret': it holds {len(left.strip())} of 64 .* remove"):
        RunFolder(tmp_path).secret()
    (tmp_path / "secret").unlink()
    assert len(RunFolder(tmp_path).secret()) == 64


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o666])
def test_one_that_others_could_read_is_closed_to_them(tmp_path: Path, mode: int) -> None:
    first = RunFolder(tmp_path).secret()
    (tmp_path / "secret").chmod(mode)
    assert RunFolder(tmp_path).secret() == first
    assert stat.S_IMODE((tmp_path / "secret").stat().st_mode) == 0o600
