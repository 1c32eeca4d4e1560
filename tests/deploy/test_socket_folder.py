"""Where a run's sockets lie: where they fit, locked, and swept once their launcher is gone."""

import errno
import os
import signal
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from rmc.common.errors import ConfigError, RoleDied
from rmc.deploy.redis import socket_folder
from rmc.deploy.redis.server import SOCKET_PATH_LIMIT, RedisServer
from rmc.deploy.redis.socket_folder import LONGEST_NAME, SocketFolder, place_for_sockets, remove_stale
from tests.raising import raising

ODD = "a#b?c%d e\"f\\g'h+ü&@*[i]"
HOLDER = """
import sys
from rmc.deploy.redis.socket_folder import SocketFolder
held = SocketFolder()
print(held.path, flush=True)
sys.stdin.read()
"""


@pytest.fixture
def temporary(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A temporary folder of the test's own, short and with an odd name."""
    with tempfile.TemporaryDirectory(prefix="rmc-", dir="/tmp") as name:  # TMPDIR may be long already
        place = Path(name) / ODD
        place.mkdir()
        set_temporary(monkeypatch, place)
        yield place


def set_temporary(monkeypatch: pytest.MonkeyPatch, place: Path) -> None:
    monkeypatch.setenv("TMPDIR", str(place))
    monkeypatch.setattr(tempfile, "tempdir", str(place))


def holder(*before: str) -> tuple[subprocess.Popen[str], Path]:
    """A process with a folder of its own."""
    process = subprocess.Popen(
        [*before, sys.executable, "-c", HOLDER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    return process, Path(process.stdout.readline().strip())


def end(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGKILL)
    process.communicate()


def test_an_odd_name_is_quoted_wherever_it_stands(temporary: Path) -> None:
    folder = SocketFolder()
    assert folder.path.parent == temporary
    with RedisServer(folder.path) as server:
        assert server.alive()
    folder.close()
    assert not folder.path.exists()


def test_one_that_is_too_long_for_sockets_is_passed_over(
    temporary: Path, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    long = temporary / ("x" * 60)
    long.mkdir()
    monkeypatch.setattr(socket_folder, "USUAL", (temporary,))
    set_temporary(monkeypatch, long)
    folder = SocketFolder()
    assert folder.path.parent == temporary
    assert len(os.fsencode(folder.path / LONGEST_NAME)) <= SOCKET_PATH_LIMIT
    folder.close()


def test_where_none_fits_one_line_names_it(temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    long = temporary / ("x" * 90)
    long.mkdir()
    monkeypatch.setattr(socket_folder, "USUAL", ())
    set_temporary(monkeypatch, long)
    with pytest.raises(ConfigError, match=r"TMPDIR='.*xxx': the path of a socket there has more than 10\d bytes; set"):
        place_for_sockets()


def test_one_that_is_no_text_is_passed_over(temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket_folder, "USUAL", (temporary,))
    (raw := temporary / os.fsdecode(b"\xff")).mkdir()
    set_temporary(monkeypatch, raw)
    assert place_for_sockets() == temporary


def test_without_any_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: ["/nowhere"])
    monkeypatch.setenv("TMPDIR", "/nowhere")
    with pytest.raises(ConfigError, match="TMPDIR='/nowhere': no temporary folder can be written"):
        place_for_sockets()


@pytest.mark.skipif(sys.platform != "linux", reason="unshare is Linux's")
def test_what_another_pid_namespace_holds_is_left_until_it_ends(temporary: Path) -> None:
    """There a launcher has a number that nobody has here, or that somebody else has."""
    unshare = ["unshare", "--user", "--map-root-user", "--pid", "--fork", "--kill-child"]
    if subprocess.run([*unshare, "true"], capture_output=True).returncode:
        pytest.skip("no namespaces here")
    process, folder = holder(*unshare)
    (folder / "redis.sock").touch()
    remove_stale(temporary)
    assert (folder / "redis.sock").exists()
    end(process)
    folder = folder.rename(folder.with_name(f"{socket_folder.PREFIX}{os.getpid()}-killed"))
    deadline_sweep(temporary, folder)


def deadline_sweep(place: Path, folder: Path) -> None:
    for _ in range(100):  # the kernel may let go of a killed process's lock a moment later
        remove_stale(place)
        if not folder.exists():
            return
        socket_folder.os.sched_yield()
    raise AssertionError(f"{folder} was not swept")


def test_starts_at_once_leave_each_other_alone(temporary: Path) -> None:
    holders = [holder() for _ in range(3)]
    assert len({folder for _, folder in holders}) == 3
    assert all(folder.is_dir() for _, folder in holders)
    for process, _ in holders:
        end(process)


def test_one_that_others_removed_is_made_again_and_locked(temporary: Path) -> None:
    folder = SocketFolder()
    folder.renew()
    folder.path.rmdir()
    folder.renew()
    remove_stale(temporary)
    assert stat.S_IMODE(folder.path.stat().st_mode) == 0o700
    folder.path.rmdir()
    folder.path.touch()
    with pytest.raises(RoleDied, match=r"was removed, and cannot be made again \(File exists\)"):
        folder.renew()
    folder.path.unlink()
    folder.close()


def test_so_is_one_on_a_disk_that_locks_no_folders(temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket_folder, "try_lock", raising(OSError(errno.EBADF, os.strerror(errno.EBADF))))
    folder = SocketFolder()
    folder.path.rmdir()
    folder.renew()
    assert folder.path.is_dir()
    folder.close()


def test_one_that_others_removed_is_closed_in_silence(temporary: Path) -> None:
    folder = SocketFolder()
    folder.path.rmdir()
    folder.close()
