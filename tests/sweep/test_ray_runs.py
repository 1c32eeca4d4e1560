"""Whole runs on a Ray of this machine: their folders come here without the ring, and go on from there."""

import errno
import os
import shutil
import tempfile
import time
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from rmc.cli import main, parser, sweep_command
from rmc.cli.sweep_command import Work
from rmc.common.errors import ConfigError
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.state import run_state
from rmc.sweep import ray_runs
from rmc.sweep.job import Job
from rmc.sweep.node_run import _is_abandoned
from rmc.sweep.parcel import pack, unpack
from rmc.sweep.ray_runs import RayRun, RayRuns
from tests.cluster.test_ray import leaves_nothing_behind
from tests.command import complaint
from tests.sweep.sweeping import ENDLESS, PENDULUM, Sweeping, write_spec

assert leaves_nothing_behind  # Ray keeps a few files of its own
RAY = ("--launcher", "ray", "--ray-address", "local")
BASE = Path(tempfile.gettempdir()) / f"rmc-sweep-{os.getuid()}"


def kept() -> list[Path]:
    """What the runs have left on their node."""
    return list(BASE.iterdir()) if BASE.exists() else []


@pytest.mark.long
def test_runs_are_spread_and_their_folders_come_without_the_ring(tmp_path: Path) -> None:
    folder, spec = tmp_path / "sweep", str(write_spec(tmp_path, seeds=(1, 2)))
    with Sweeping(folder, spec, *RAY) as sweep:
        assert sweep.finish() == 0, sweep.text()
    assert sweep.states() == {"seed=1": "finished", "seed=2": "finished"}
    for name in sweep.states():
        run = RunFolder(folder / name)
        assert run.result() is not None
        assert run.lock.ended() == 0
        assert {"config.json", "metrics.jsonl", "checkpoints"} <= {path.name for path in run.path.iterdir()}
        assert not run.rings()
        assert "after training" in (folder / "logs" / f"{name}.log").read_text()
    assert not kept()


@pytest.mark.long
@pytest.mark.timeout(300)
def test_a_stopped_and_a_lost_run_go_on_with_the_same_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, spec = tmp_path / "sweep", str(write_spec(tmp_path, **ENDLESS))
    with Sweeping(folder, spec, *RAY) as sweep:
        sweep.wait_for_updates("seed=0")
        run = RunFolder(folder / "seed=0")
        assert run_state(run) == "training"
        assert "this run is being trained; stop it first" in complaint(["resume", str(run.path)], capsys)
        assert "is trained on Ray; stop its sweep" in complaint(["stop", str(run.path)], capsys)
        assert sweep.interrupt() == 130
    assert sweep.states() == {"seed=0": "stopped"}
    assert run.lock.ended() == 130
    assert f"rmc resume {run.path}" in (folder / "logs" / "seed=0.log").read_text()
    saved = sorted(path.name for path in run.checkpoints.glob("[0-9]*"))
    assert saved
    with Sweeping(folder, spec, *RAY) as sweep:
        sweep.wait_for(lambda: sorted(path.name for path in run.checkpoints.glob("[0-9]*"))[-1] > saved[-1])
        train = next(one for one in _processes() if "train" in one.info["cmdline"])
        host = train.parent()
        assert host is not None
        host.kill()  # as a node that is gone
        assert sweep.finish() == 1
        assert not train.is_running()
    assert "without their replay ring, these continue" in sweep.text()
    assert sweep.lines()["seed=0"]["state"] == "failed"
    assert "its node was lost" in sweep.lines()["seed=0"]["reason"]
    assert run_state(run) == "stopped"
    assert sweep.text().count("its node was lost") == 1


def _processes() -> Iterator[psutil.Process]:
    for one in psutil.process_iter(["cmdline"]):
        if any(word.startswith(str(BASE)) for word in one.info["cmdline"] or []):
            yield one


def test_nodes_hold_as_many_runs_as_fit_and_one_at_least(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = [(True, 5.0, 8e9), (True, 2.0, 1e9), (False, 64.0, 64e9)]  # whether it is there, its CPUs, its memory
    has = [{"Alive": alive, "Resources": {"CPU": cpus, "memory": memory}} for alive, cpus, memory in nodes]
    monkeypatch.setattr(ray_runs.ray, "nodes", lambda: has)
    assert RayRuns(2, 1_000_000_000, 0, 0).capacity() == 3
    assert RayRuns(2, 2_000_000_000, 0, 0).capacity() == 2
    assert RayRuns(2, 2_000_000_000, 0, at_once=1).capacity() == 1
    for needs in ((6, 1_000, 0), (1, 9_000_000_000, 0), (1, 1_000, 1)):
        with pytest.raises(ConfigError, match=r"no node of the cluster has .*, which a run takes; start one that has"):
            RayRuns(*needs, at_once=0)


def test_a_copy_is_like_the_folder_and_only_what_changed_is_sent(tmp_path: Path) -> None:
    source, copy = tmp_path / "source", tmp_path / "copy"
    (source / "checkpoints" / "1").mkdir(parents=True)
    (source / "replay").mkdir()
    (source / "replay" / "ring").write_bytes(b"0" * 9999)
    (source / "checkpoints" / "1" / "policy").write_text("one")
    (source / "metrics.jsonl").write_text("first\n")
    (source / "secret").write_text("s")
    (source / "secret").chmod(0o600)
    parcel = pack(source, {})
    (copy / "replay").mkdir(parents=True)
    (copy / "checkpoints" / "0").mkdir(parents=True)
    (copy / "checkpoints" / "0" / "policy").write_text("old")
    (copy / "notes").write_text("mine")
    unpack(parcel, copy, {"checkpoints/0/policy": (3, 0)})
    assert (copy / "notes").read_text() == "mine"
    (copy / "notes").unlink()
    assert (
        _content(copy) == _content(source) == {"checkpoints/1/policy": "one", "metrics.jsonl": "first\n", "secret": "s"}
    )
    assert (copy / "secret").stat().st_mode & 0o777 == 0o600
    assert not (copy / "checkpoints" / "0").exists()
    assert (copy / "replay").is_dir()  # its own

    time.sleep(0.01)
    with (source / "metrics.jsonl").open("a") as file:
        file.write("second\n")
    (source / "checkpoints" / "1").rename(source / "checkpoints" / "2")
    (source / "events").mkdir()
    later = pack(source, parcel.stamps)
    unpack(later, copy, parcel.stamps)
    assert _content(copy) == {"checkpoints/2/policy": "one", "metrics.jsonl": "first\nsecond\n", "secret": "s"}
    assert (copy / "events").is_dir()
    assert sorted(later.files) == ["checkpoints/2/policy", "metrics.jsonl"]
    assert pack(source, later.stamps).files == {}


def test_a_run_that_is_trained_by_hand_is_not_sent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = [{"Alive": True, "Resources": {"CPU": 2.0, "memory": 8e9}}]
    monkeypatch.setattr(ray_runs.ray, "nodes", lambda: nodes)
    by_hand = RunFolder(tmp_path).lock
    by_hand.take()
    with pytest.raises(ConfigError, match="this run is being trained; stop it first"):
        RayRuns(1, 1_000, 0, 0).start(Job(tmp_path, ("train", PENDULUM), 0))
    by_hand.release()


def test_neither_the_lock_nor_a_ring_is_sent(tmp_path: Path) -> None:
    (tmp_path / "replay-0").mkdir()
    (tmp_path / "replay-0" / "ring").touch()
    (tmp_path / ".lock").write_text("ended 0")
    (tmp_path / "config.json").touch()
    assert list(pack(tmp_path, {}).stamps) == ["config.json"]


def test_a_kill_while_a_copy_is_written_leaves_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, copy = tmp_path / "source", tmp_path / "copy"
    source.mkdir()
    (source / "metrics.jsonl").write_text("first\n")
    before = pack(source, {})
    unpack(before, copy, {})
    (source / "metrics.jsonl").write_text("first\nsecond\n")

    def cut(path: Path, content: bytes) -> int:
        with path.open("wb") as file:
            file.write(content[:3])
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_bytes", cut)
    with pytest.raises(KeyboardInterrupt):
        unpack(pack(source, before.stamps), copy, before.stamps)
    assert _content(copy) == {"metrics.jsonl": "first\n"}


def test_a_full_disk_here_is_waited_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, answer, tries = tmp_path / "source", object(), [errno.ENOSPC, 0]
    source.mkdir()
    (source / "result.json").write_text("{}")
    monkeypatch.setattr(ray_runs.ray, "wait", lambda ids, timeout: (ids, []))
    monkeypatch.setattr(ray_runs.ray, "get", lambda _: (0, pack(source, {}), b"log"))
    monkeypatch.setattr(ray_runs.ray, "kill", lambda _: None)

    def full_once(*of: Any) -> None:
        if error := tries.pop(0):
            raise OSError(error, "No space left on device")
        unpack(*of)

    monkeypatch.setattr(ray_runs, "unpack", full_once)
    run, ended = RayRun.__new__(RayRun), []
    run._runs, run._actor = types.SimpleNamespace(release=lambda: ended.append(1)), None  # type: ignore[assignment]
    run._job = Job(tmp_path / "runs" / "one", (), 0, {})
    run._lost, run._lock = "", RunFolder(run._job.folder).lock
    run._log, run._stamps, run._pending, run._look_at, run._killed = b"", {}, answer, 0.0, False
    assert run.status() is None
    assert run._pending is answer
    assert run.status() == 0
    assert (run._job.folder / "result.json").exists()
    assert ended == [1]

    tries[:], run._pending = [errno.ENOSPC] * 2, answer
    assert run.status() is None
    run.kill()
    assert run.status() == ray_runs.LOST
    assert run.last_words() == "its last files found no room here (No space left on device)"


def test_a_copy_that_goes_back_is_not_sent_again(tmp_path: Path) -> None:
    source, copy = tmp_path / "source", tmp_path / "copy"
    source.mkdir()
    for number in range(50):
        (source / str(number)).touch()
        os.utime(source / str(number), ns=(0, 1_795_000_000_123_456_789 + 7_001_003 * number))
    unpack(pack(source, {}), copy, {})
    assert pack(copy, pack(source, {}).stamps).files == {}


def test_folders_may_vanish_as_they_are_packed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "checkpoints" / "1").mkdir(parents=True)
    (tmp_path / "checkpoints" / "1" / "policy").touch()
    scandir = os.scandir

    def gone(path: str) -> object:
        if str(path).endswith("/1"):
            shutil.rmtree(path)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", gone)
    assert pack(tmp_path, {}).stamps == {}


def test_what_another_run_removes_is_not_looked_at(tmp_path: Path) -> None:
    folder = tmp_path / "left"
    assert not _is_abandoned(folder)
    folder.mkdir()
    assert not _is_abandoned(folder)  # it may just begin
    os.utime(folder, (0.0, 0.0))
    assert _is_abandoned(folder)


def _content(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != "ring")
    return {str(path.relative_to(folder)): path.read_text() for path in files}


@pytest.mark.parametrize(
    ("words", "threads"),
    [
        ([], [1]),
        (["--threads=8"], [8]),
        (["--grid", "threads=0,2"], [0, 2]),
        (["--search", "learning_rate=1e-4,1e-3", "--trials", "1"], [1]),
    ],
)
def test_a_run_takes_one_thread_unless_more_are_asked_for(
    words: list[str], threads: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As many as are reserved: by itself a learner would try all of the node's cores."""
    sent: list[int] = []

    def send(_: Any, work: Work, *__: Any) -> int:
        jobs = iter(work.plan.next, None)
        sent.extend(parser.parse(list(job.words)).config().learner.threads for job in jobs)
        return 0

    monkeypatch.setattr(sweep_command, "_conduct", send)
    sweep = ["sweep", PENDULUM, *RAY, "--sweep-dir", str(tmp_path / "sweep"), "--preset", "debug", *words]
    assert main.run(sweep) == 0
    assert sent == threads
