"""A run's small files: the secret, its owner's alone and the same for all who ask at once; what is odd is said."""

import dataclasses
import errno
import json
import os
import resource
import shutil
import stat
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import Barrier
from typing import Any

import pytest
from rich.console import Console

from rmc.analysis.history import of_run
from rmc.cli.main import run
from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.monitor.monitor import Monitor
from rmc.deploy.monitor.output import Output
from rmc.deploy.run import folder as run_folder
from rmc.deploy.run.config import to_json
from rmc.deploy.run.folder import RESULT, RunFolder
from rmc.deploy.run.launch_options import IfExists, LaunchOptions
from rmc.deploy.run.metrics_tail import wall_seconds
from rmc.deploy.run.opening import make, open_run
from rmc.deploy.run.presets import debug
from rmc.deploy.run.state import run_state
from tests.command import complaint
from tests.raising import raising
from tests.runs import untrained


def test_a_run_that_is_renamed_is_known_but_a_copy_is_another(tmp_path: Path) -> None:
    """To the nodes of a cluster, and in a Redis of the user's own though its folder has the same name."""
    first = RunFolder(tmp_path / "run")
    first.path.mkdir()
    name = first.identity()
    time.sleep(0.02)  # a copy within a tick of the clock that files are stamped with would be the same
    shutil.copytree(first.path, tmp_path / "other" / "run")
    assert len({first.name, first.name, RunFolder(tmp_path / "other" / "run").name}) == 2
    first.path.rename(tmp_path / "renamed")
    assert RunFolder(tmp_path / "renamed").identity() == name
    time.sleep(0.02)
    shutil.copytree(tmp_path / "renamed", tmp_path / "copy")
    copies = {RunFolder(tmp_path / "copy").identity() for _ in range(2)}
    assert len(copies | {name}) == 2
    (tmp_path / "copy" / "scratch").write_text("damaged")
    assert RunFolder(tmp_path / "copy").identity() not in copies | {name}


@pytest.mark.parametrize("changed", [0, 1])
def test_a_run_is_known_by_its_folder_or_its_secret(tmp_path: Path, changed: int) -> None:
    """A remount may give the folder another number, ``chown`` changes when the secret changed."""
    name = RunFolder(tmp_path).identity()
    note = tmp_path / "scratch"
    words = note.read_text().split()
    note.write_text(" ".join("1" if at == changed else word for at, word in enumerate(words)))
    assert RunFolder(tmp_path).identity() == name
    assert note.read_text().split() == words
    note.write_text(f"{words[0]} {name}\n")  # as versions before wrote it
    assert RunFolder(tmp_path).identity() == name
    folder = RunFolder(tmp_path)
    name = folder.name
    shutil.rmtree(tmp_path)
    assert folder.name == name  # also where the folder was deleted or moved


def test_a_full_disk_keeps_no_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = RunFolder(tmp_path)
    folder.lock.take()
    folder.lock.release(130)
    folder.lock.take()
    text = (tmp_path / ".lock").read_text()
    assert text.startswith("training ")
    assert str(os.getpid()) in text

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", raising(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
        folder.lock.release(130)
        with pytest.raises(OSError, match="No space"):
            folder.lock.take()
    RunFolder(tmp_path).lock.take()


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
    secret = RunFolder(tmp_path).secret()
    assert synchronised == [(secret + b"\n", False)]


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


@pytest.mark.parametrize("fault", [None, errno.EOPNOTSUPP, errno.EPERM])
def test_a_secret_is_made_once_on_a_disk_without_hard_links_too(
    fault: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if fault is not None:
        monkeypatch.setattr(os, "link", raising(OSError(fault, os.strerror(fault))))
    secret = RunFolder(tmp_path).secret()
    assert len(bytes.fromhex(secret.decode())) == 32
    assert RunFolder(tmp_path).secret() == secret
    assert stat.S_IMODE((tmp_path / "secret").stat().st_mode) == 0o600
    assert [path.name for path in tmp_path.iterdir()] == ["secret"]


@pytest.mark.parametrize("fault", [errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK])
def test_a_disk_without_locks_is_one_line_before_there_is_a_run(
    fault: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fcntl.flock", raising(OSError(fault, os.strerror(fault))))
    with pytest.raises(ConfigError, match=r"^lock='.*/run/.lock': its disk locks no files \(.+\); take a folder on an"):
        open_run(debug(EnvConfig("InvertedPendulum-v5")), LaunchOptions(tmp_path / "run", "fail"))
    assert not (tmp_path / "run" / "config.json").exists()


@pytest.mark.parametrize("fault", [errno.EROFS, errno.EACCES])
def test_a_run_that_cannot_be_written_is_to_be_copied(
    fault: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = untrained(tmp_path / "run", debug(EnvConfig("Pendulum-v1")))
    monkeypatch.setattr("rmc.deploy.run.run_lock.take_lock", raising(OSError(fault, os.strerror(fault))))
    line = (
        f"rmc: RUN='{run.path}': cannot be written ({os.strerror(fault)}); copy the run elsewhere, or make it writable"
    )
    assert complaint(["resume", str(run.path), "--device", "cpu"], capsys) == line


@pytest.mark.parametrize("fault", [errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK])
def test_a_copy_on_a_disk_without_locks_can_be_read(
    fault: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = open_run(debug(EnvConfig("InvertedPendulum-v5")), LaunchOptions(tmp_path / "run", "fail"))
    shutil.copytree(folder.path, tmp_path / "copy")
    folder.lock.release()
    monkeypatch.setattr("fcntl.flock", raising(OSError(fault, os.strerror(fault))))
    assert run_state(RunFolder(tmp_path / "copy")) == "lost"


@pytest.mark.skipif(os.getuid() != 0, reason="only root can be somebody else")
def test_a_folder_of_another_owner_that_can_be_written_is_taken(tmp_path: Path) -> None:
    let_others_pass(tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run").chmod(0o777)
    folder = RunFolder(tmp_path / "run")
    with as_nobody():
        make(folder)
        folder.lock.take()
        folder.lock.release()
        folder.secret()
    assert folder.secret_file.stat().st_uid == folder.checkpoints.stat().st_uid == 65534
    assert stat.S_IMODE(folder.secret_file.stat().st_mode) == 0o600


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


def test_a_run_that_is_made_longer_has_no_result_until_it_ends(folder: RunFolder) -> None:
    config = folder.config()
    folder.write_result(dict.fromkeys(RESULT, config.total_steps))
    for more, there in ((0, True), (1, False)):
        open_run(
            dataclasses.replace(config, total_steps=config.total_steps + more), LaunchOptions(folder.path)
        ).lock.release()
        assert (folder.result() is not None) == there


def test_a_start_that_fails_takes_no_result_along(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    config = folder.config()
    folder.write_result(dict.fromkeys(RESULT, config.total_steps))

    monkeypatch.setattr("rmc.deploy.run.opening.note_start", raising(OSError(errno.ENOSPC, "no room")))
    with pytest.raises(OSError, match="no room"):
        open_run(dataclasses.replace(config, total_steps=config.total_steps + 1), LaunchOptions(folder.path))
    assert folder.result() is not None


@pytest.mark.parametrize("if_exists", ["resume", "fail", "new"])
def test_starts_in_the_same_second_get_a_folder_each(
    if_exists: IfExists, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.strftime", lambda *_: "20260102-030405")
    barrier = Barrier(4)

    def start(_: int) -> RunFolder:
        barrier.wait()
        return open_run(debug(EnvConfig("InvertedPendulum-v5")), LaunchOptions(None, if_exists))

    with ThreadPoolExecutor(4) as pool:
        runs = list(pool.map(start, range(4)))
    name = "InvertedPendulum-v5__debug__0__20260102-030405"
    assert {one.path.name for one in runs} == {name, *(f"{name}-{number}" for number in (2, 3, 4))}
    assert {stat.S_IMODE(one.path.stat().st_mode) for one in runs} == {0o700}
    for one in runs:
        one.lock.release()


def test_a_place_for_runs_that_is_none_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").touch()
    with pytest.raises(ConfigError, match=r"--run-dir='.*runs.*cannot be made \(.+\); give another"):
        open_run(debug(EnvConfig("InvertedPendulum-v5")), LaunchOptions())


def test_a_folder_that_turns_read_only_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It is said once each way, and the result comes when there is a place for it."""
    monkeypatch.setattr("rmc.deploy.monitor.monitor.RECORD_SECONDS", 0.0)
    config = debug(EnvConfig("InvertedPendulum-v5"))
    folder = open_run(config, LaunchOptions(tmp_path / "run", "fail"))
    let_others_pass(tmp_path)  # root, whom no mode keeps from writing, becomes another
    os.chown(folder.path, 65534, -1)
    monitor = Monitor(folder, config, Console(quiet=True))
    monitor.watch(MemoryBus())
    folder.path.chmod(0o500)
    with ThreadPoolExecutor(1) as pool, as_nobody():
        for _ in range(3):
            monitor.watch(MemoryBus())
        written = pool.submit(folder.write_result, {"env_steps": 1})
        time.sleep(0.2)
        assert not written.done()
        folder.path.chmod(0o700)
        written.result(5.0)
    monitor.watch(MemoryBus())
    assert folder.result_file.exists()
    messages = [message.partition("run ")[2] for message in caplog.messages]
    assert messages == ["is read-only: training goes on, its end waits", "can be written again"]
    monitor.close()
    folder.lock.release()


def let_others_pass(folder: Path) -> None:
    """Into a test's folder, through those of the session alone."""
    for path in (folder, *folder.parents):
        if "/rmct-" in str(path):  # as tests/conftest.py names them
            path.chmod(0o711)


@contextmanager
def as_nobody() -> Iterator[None]:
    """Where this process is root, for as long as this lasts."""
    if os.getuid():
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def test_a_name_that_is_no_text_is_refused(tmp_path: Path) -> None:
    """It stands in keys, and in what roles are started with."""
    no_text = tmp_path / os.fsdecode(b"\xff")
    with pytest.raises(ConfigError, match=r"--run-dir='.*\\udcff/run': is no UTF-8; give another"):
        open_run(debug(EnvConfig("InvertedPendulum-v5")), LaunchOptions(no_text / "run", "fail"))
    assert list(tmp_path.iterdir()) == []


def test_a_result_waits_for_room(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    faults, write = iter((errno.ENOSPC, errno.EDQUOT)), run_folder.write_whole

    def full_at_first(path: Path, content: bytes) -> None:
        for fault in faults:
            raise OSError(fault, os.strerror(fault))
        write(path, content)

    monkeypatch.setattr(run_folder, "write_whole", full_at_first)
    monkeypatch.setattr(run_folder, "ROOM_SECONDS", 0.01)
    folder.write_result(dict.fromkeys(RESULT, 1))
    assert folder.result() == dict.fromkeys(RESULT, 1)
    assert [one.getMessage() for one in caplog.records] == [
        f"{folder.result_file} finds no room; waiting until there is some"
    ]


def test_odd_lines_of_metrics_are_passed_over(folder: RunFolder) -> None:
    evaluation = {"role": "evaluator", "eval_update": 50, "eval_return_mean": 7.0, "eval_return_std": 1.0}
    records = [{"role": "launcher", "time": 1.0, "wall_s": 3.0}, evaluation | {"time": 1.0}]
    odd = [b"5", b'{"a": 1}', b'{"role": 1}', b'{"role": "launcher", "wall_s": "abc"}', b"\xff", b'{"role": "launch']
    folder.metrics.write_bytes(b"\n".join([odd[-2], *(json.dumps(one).encode() for one in records), *odd]))
    assert wall_seconds(folder.metrics) == 3.0
    folder.write_initial({"eval_return_mean": 2.0, "eval_return_std": 0.0, "eval_episodes": 10})
    history = of_run(folder)
    assert ([one.return_mean for one in history.evaluations], history.initial_return) == ([7.0], 2.0)
    assert run(["stats", str(folder.path)]) == 0


STRANGE = "\x1b]0;title\x07"


def test_what_a_strangers_metrics_would_do_to_a_terminal_is_not_printed(
    folder: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    record = {"role": "learner", "time": 1.0, f"{STRANGE}_loss": 0.5, "model_loss": 0.5}
    lines = [record | {"role": f"actor-0{STRANGE}", "busy_share": 0.5}, record]
    folder.metrics.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    assert list(folder.records()) == [{"role": "learner", "time": 1.0, "model_loss": 0.5}]
    assert run(["stats", str(folder.path)]) == 0
    assert "\x1b]" not in capsys.readouterr().out


@pytest.mark.parametrize("changed", [{"env": {"id": f"Ant-v5{STRANGE}"}}, {"preset": f"debug{STRANGE}"}])
def test_a_strangers_config_that_cannot_be_shown_is_one_line(
    folder: RunFolder, changed: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    (folder.path / "config.json").write_text(json.dumps(json.loads(to_json(folder.config())) | changed))
    line = complaint(["stats", str(folder.path)], capsys)
    assert "config.json has no env, seed or total_steps" in line
    assert run(["list", str(folder.path)]) == 0
    listed = capsys.readouterr().out
    assert "damaged" in listed
    assert "\x1b" not in line + listed


BASELINE = json.dumps({"algorithm": "sac"})
OURS = to_json(debug(EnvConfig("InvertedPendulum-v5")))
TRAIN = ["train", "InvertedPendulum-v5", "--run-dir"]


@pytest.mark.parametrize(
    ("files", "fault", "commands"),
    [
        ({"config.json": "5"}, "must be an object", [["stats"], ["attach"], ["stop"], ["plot"], ["evaluate"], TRAIN]),
        ({"config.json": "{"}, "not JSON", [["stats"], ["stop"], ["plot"], ["evaluate"], ["export"], TRAIN]),
        ({"config.json": "{}"}, "is missing", [["plot"], ["inspect"]]),
        ({"config.json": "{}"}, "has no env, seed or total_steps", [["stats"]]),
        ({"config.json": BASELINE}, "is a baseline's run", [["export"], ["inspect"], TRAIN]),
        ({"config.json": BASELINE}, "nobody trains it now", [["stop"], ["attach"]]),
        ({"config.json": BASELINE}, "no baseline's of this version ('env')", [["plot"], ["evaluate"]]),
        ({"config.json": OURS, "result.json": '{"a": 1}'}, "result.json", [["plot"], ["stats"]]),
        ({"config.json": OURS, "result.json": '{"env_st'}, "result.json", [["plot"], ["stats"]]),
    ],
)
def test_odd_files_are_named_in_one_line(
    files: dict[str, str], fault: str, commands: list[list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = {"role": "evaluator", "time": 1.0, "eval_update": 5, "eval_return_mean": 7.0, "eval_return_std": 1.0}
    for name, text in (files | {"metrics.jsonl": json.dumps(record)}).items():
        (tmp_path / name).write_text(text)
    for command in commands:
        line = complaint([*command, str(tmp_path)], capsys)
        assert fault in line
        assert str(tmp_path) in line


@pytest.mark.parametrize("command", ["stats", "evaluate", "resume"])
@pytest.mark.parametrize(
    ("place", "says"),
    [
        ("frist", "did you mean first?"),
        ("*", "give "),
        (".", "holds runs; give one of them, as rmc list names them"),
        ("first/checkpoints/000000333", "is a checkpoint; give its run, {tmp_path}/first"),
        ("first/checkpoints", "no config.json there; give the folder of a run"),
    ],
)
def test_what_is_no_runs_folder_comes_with_what_to_give(
    place: str, says: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = untrained(tmp_path / "first", debug(EnvConfig("Pendulum-v1")))
    (run.checkpoints / "000000333").mkdir()
    line = complaint([command, str(tmp_path / place)], capsys)
    assert line.startswith(f"rmc: RUN='{tmp_path / place}': ")
    assert says.format(tmp_path=tmp_path) in line


@pytest.mark.parametrize("words", [["stats"], ["resume"], ["stop"], ["train", "Pendulum-v1", "--run-dir"]])
def test_a_link_to_itself_is_one_line(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Output, "log", None)  # that of an earlier test's run
    (tmp_path / "loop").symlink_to("loop")
    assert "loop" in complaint([*words, str(tmp_path / "loop")], capsys)


def test_a_baseline_is_not_filmed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "config.json").write_text(BASELINE)
    line = complaint(["evaluate", str(tmp_path), "--video", "x.mp4"], capsys)
    assert "--video='x.mp4': only runs of rmc train are filmed" in line


def test_a_newer_damaged_checkpoint_is_told_where_the_run_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = debug(EnvConfig("Pendulum-v1"))
    folder = untrained(tmp_path / "run", config)
    checkpoints = CheckpointFolder(folder.checkpoints)
    for update in (10, 20, 30):
        checkpoints.save(update, {"state": b"x"})
    for update in (20, 30):
        (checkpoints.path(update) / "state").write_bytes(b"y")
    (folder.path / "replay").mkdir()
    untrained(tmp_path / "run", config)
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 3
    assert all("does not match its manifest; it is passed over" in text for text in messages[:2])
    assert "000000030" in messages[0]
    assert messages[2] == "the run goes on from the checkpoint of update 10"
