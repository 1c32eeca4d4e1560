"""What may be other when a run goes on: every option is one or the other, and each change is in the run's history."""

import dataclasses
import json
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.run import metrics_tail, opening
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RESULT, RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import MAY_CHANGE, open_run, taken_up
from rmc.deploy.run.option_names import flat
from rmc.deploy.run.presets import debug
from rmc.deploy.run.starts import format_starts, last_launch, starts
from rmc.deploy.run.state import run_state
from tests.deploy.test_config import with_value
from tests.raising import raising

CONFIG = debug(EnvConfig("InvertedPendulum-v5"))
FINISHED = dict.fromkeys(RESULT, 4_000) | {"eval_cut": 0.0}


def another(path: str, value: Any) -> Any:
    """Of the same kind."""
    kind: Any = RunConfig
    for name in path.split("."):
        kind = get_type_hints(kind)[name]
    if choices := [choice for choice in get_args(kind) if choice != value and not isinstance(choice, type)]:
        return choices[0]
    match value:
        case bool():
            return not value
        case str():
            return "Pendulum-v1"
        case dict():
            return {"goal": 1}
        case tuple():
            return (7, *value[1:])
    return value + 1


@pytest.mark.parametrize("path", flat(CONFIG))
def test_every_option_may_change_or_is_refused_with_the_reason(path: str, folder: RunFolder) -> None:
    was = flat(CONFIG)[path]
    changed = with_value(CONFIG, path, another(path, was))
    if path in MAY_CHANGE:
        open_run(changed, LaunchOptions(folder.path)).lock.release()
        assert folder.config() == changed
        assert starts(folder)[-1].changes == {path: [was, flat(changed)[path]]}
    else:
        message = r": the run in .*run has .*, and .+; use that, or another --run-dir"
        with pytest.raises(ConfigError, match=message) as no:
            open_run(changed, LaunchOptions(folder.path))
        assert repr(flat(changed)[path]) in str(no.value)
        assert folder.config() == CONFIG
        assert len(starts(folder)) == 1


def test_a_run_with_no_step_to_train_takes_no_option_that_would_wait(folder: RunFolder) -> None:
    changed = with_value(CONFIG, "actors", 3)
    folder.write_result(FINISHED)
    with pytest.raises(ConfigError, match="--actors=3: all 4,000 steps are trained; leave it, or take more --total"):
        open_run(changed, LaunchOptions(folder.path))
    assert (folder.config(), folder.result(), len(starts(folder))) == (CONFIG, FINISHED, 1)
    assert taken_up(folder, changed, LaunchOptions(folder.path, launcher="ray")) == CONFIG  # fitted to the cluster
    open_run(dataclasses.replace(changed, total_steps=9_000), LaunchOptions(folder.path)).lock.release()
    assert folder.result() is None


@pytest.mark.parametrize("path", sorted(opening.LAST_EVALUATION))
def test_a_run_with_no_step_to_train_takes_what_its_last_evaluation_does(path: str, folder: RunFolder) -> None:
    changed = with_value(CONFIG, path, 3_000 if path == "total_steps" else another(path, flat(CONFIG)[path]))
    folder.write_result(FINISHED)
    open_run(changed, LaunchOptions(folder.path)).lock.release()
    assert (folder.config(), folder.result()) == (changed, FINISHED)


def test_a_run_goes_on_from_an_older_checkpoint_and_is_refused_where_none_is_whole(folder: RunFolder) -> None:
    checkpoints = CheckpointFolder(folder.checkpoints)
    for number in (1, 2):
        checkpoints.save(number, {"learner.pt": b"whole"})
    (folder.path / "replay").mkdir()
    (checkpoints.path(2) / "learner.pt").write_bytes(b"other")
    open_run(CONFIG, LaunchOptions(folder.path)).lock.release()
    (checkpoints.path(1) / "learner.pt").write_bytes(b"other")
    message = "000000002: learner.pt does not match its manifest; none is whole, so use another"
    with pytest.raises(ConfigError, match=message):
        open_run(CONFIG, LaunchOptions(folder.path))


def test_a_copy_without_its_checkpoints_is_refused(folder: RunFolder) -> None:
    """One that was killed before the first is not."""
    said = {"role": "learner", "time": 1.0, "env_steps": 900, "checkpoint_update": 0}
    for update in (0, 30):
        folder.metrics.write_text(json.dumps(said | {"checkpoint_update": update}) + "\n")
        if update == 0:
            open_run(CONFIG, LaunchOptions(folder.path)).lock.release()
    with pytest.raises(ConfigError, match=r"has lost its checkpoints; restore them, or take another --run-dir"):
        open_run(CONFIG, LaunchOptions(folder.path))
    taken_up(folder, CONFIG, LaunchOptions(folder.path, launcher="manual"))  # they may be elsewhere


def test_a_run_that_has_lost_what_it_began_with_keeps_its_result(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(opening, "begun_with", lambda _: {"asked": ["another", "all"]})
    CheckpointFolder(folder.checkpoints).save(30, {"learner.pt": b"whole"})
    (folder.path / "replay").mkdir()
    folder.write_result(FINISHED)
    open_run(CONFIG, LaunchOptions(folder.path)).lock.release()  # no step is missing
    with pytest.raises(ConfigError, match=r"initial.json': is lost or damaged, and so is what the run began with"):
        open_run(dataclasses.replace(CONFIG, total_steps=9_000), LaunchOptions(folder.path))
    assert folder.result() == FINISHED


@pytest.mark.parametrize("kept", ["replay", "replay-1", "replay-counters"])
def test_a_copy_without_what_counts_its_steps_is_refused(kept: str, folder: RunFolder) -> None:
    CheckpointFolder(folder.checkpoints).save(30, {"learner.pt": b"whole"})
    (folder.path / "replay.txt").touch()
    with pytest.raises(ConfigError, match=r"neither its replay buffer nor replay-counters, which counts its steps"):
        open_run(CONFIG, LaunchOptions(folder.path))
    for launcher in ("ray", "manual"):  # where they are elsewhere
        taken_up(folder, CONFIG, LaunchOptions(folder.path, launcher=launcher))
    (folder.path / kept).mkdir()
    open_run(CONFIG, LaunchOptions(folder.path)).lock.release()


def test_a_start_that_is_refused_once_it_has_the_lock_writes_nothing(folder: RunFolder) -> None:
    """On Ray another start may have been between."""

    def refuse(locked: RunFolder) -> None:
        assert locked.lock.trainer() is not None
        raise ConfigError("--run-dir", str(locked.path), "this run is being trained")

    with pytest.raises(ConfigError, match="is being trained"):
        open_run(dataclasses.replace(CONFIG, total_steps=9_000), LaunchOptions(folder.path), check=refuse)
    assert (folder.config(), len(starts(folder)), folder.lock.trainer()) == (CONFIG, 1, None)


def test_of_two_starts_of_a_new_folder_the_later_one_removes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options, free = LaunchOptions(tmp_path / "run"), opening.check_free

    def other(folder: RunFolder) -> None:
        free(folder)
        monkeypatch.setattr(opening, "check_free", free)
        first = open_run(CONFIG, options)
        CheckpointFolder(first.checkpoints).save(500, {"learner.pt": b"trained"})
        first.lock.release(130)

    monkeypatch.setattr(opening, "check_free", other)
    with pytest.raises(ConfigError, match="another start has just made it; start again to continue it"):
        open_run(CONFIG, options)
    there = RunFolder(tmp_path / "run")
    assert CheckpointFolder(there.checkpoints).numbers() == [500]
    assert (there.lock.trainer(), there.lock.ended()) == (None, 130)


@pytest.mark.parametrize(("status", "state"), [(1, "failed"), (130, "stopped")])
def test_a_start_that_is_refused_leaves_how_the_last_one_ended(folder: RunFolder, status: int, state: str) -> None:
    folder.lock.take()
    folder.lock.release(status)

    with pytest.raises(ConfigError, match="is being trained"):
        open_run(CONFIG, LaunchOptions(folder.path), check=raising(ConfigError("--run-dir", "", "is being trained")))
    assert run_state(folder) == state
    assert folder.lock.ended() == status


def test_the_history_is_a_line_a_start(folder: RunFolder) -> None:
    assert format_starts(folder) == "1 start"
    folder.metrics.write_text('{"role": "learner", "env_steps": 1200}\n{"role": "replay", "env_steps": 1230}\n{"ro')
    folder.history_file.write_bytes(folder.history_file.read_bytes() + b'{"time": 1.0, "vers')  # torn by a crash
    replay = dataclasses.replace(CONFIG.replay, replay_ratio=8.0)
    longer = dataclasses.replace(CONFIG, total_steps=9_000, replay=replay)
    open_run(longer, LaunchOptions(folder.path)).lock.release()
    open_run(longer, LaunchOptions(folder.path)).lock.release()
    assert [start.env_steps for start in starts(folder)] == [0, 1_230, 1_230]
    assert starts(folder)[-1].changes == {}
    assert format_starts(folder) == "3 starts; from step 1,230 --total-steps 4000 to 9000, --replay-ratio 32 to 8"


def test_of_a_run_of_weeks_a_start_parses_what_was_said_last(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else every start of its launcher holds more than the one before."""
    CheckpointFolder(folder.checkpoints).save(30, {"learner.pt": b"whole"})
    (folder.path / "replay").mkdir()
    line = '{"role": "replay", "env_steps": 7, "more": "%s"}\n' % ("x" * 400)
    folder.metrics.write_text(line * 20_000 + '{"role": "replay", "env_steps": 9000}\n')
    parsed, parse = [], metrics_tail.parse_record
    monkeypatch.setattr(metrics_tail, "parse_record", lambda line: parsed.append(len(line)) or parse(line))
    open_run(CONFIG, LaunchOptions(folder.path)).lock.release()
    assert starts(folder)[-1].env_steps == 9_000
    assert 0 < sum(parsed) < 1.1 * metrics_tail.LISTED_BYTES


@pytest.mark.parametrize("link", ["checkpoints", "logs"])
def test_a_folder_that_shows_what_another_run_has_is_left_alone(link: str, tmp_path: Path) -> None:
    kept = tmp_path / "old" / link / "000001000" / "policy"
    kept.parent.mkdir(parents=True)
    kept.write_text("of value")
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / link).symlink_to(tmp_path / "old" / link)
    with pytest.raises(ConfigError, match="is there and is no run's folder"):
        open_run(CONFIG, LaunchOptions(tmp_path / "new"))
    assert kept.read_text() == "of value"


def test_a_start_that_a_damaged_result_refuses_changes_nothing(folder: RunFolder) -> None:
    folder.result_file.write_text("{")
    before = folder.config(), folder.history_file.read_bytes()
    with pytest.raises(ConfigError, match=r"result\.json"):
        open_run(with_value(CONFIG, "total_steps", 9_000), LaunchOptions(folder.path))
    assert (folder.config(), folder.history_file.read_bytes()) == before


def test_what_was_edited_to_another_kind_is_as_by_default(folder: RunFolder) -> None:
    (line,) = folder.history_file.read_text().splitlines()
    edited = {"metrics_port": "9464", "device": 5, "launcher": "locla", "all_cpus": True, "run_dir": "elsewhere"}
    folder.history_file.write_text(json.dumps(json.loads(line) | {"launch": edited}) + "\n")
    assert last_launch(folder) == LaunchOptions(folder.path, all_cpus=True)


def test_a_strangers_history_cannot_write_to_a_terminal(folder: RunFolder) -> None:
    start = json.loads(folder.history_file.read_text())
    strange = start | {"changes": {"learner.threads": [1, "\x1b]0;title\x07"]}}
    folder.history_file.write_text(json.dumps(strange) + "\n")
    assert format_starts(folder) == r"'1 start; from step 0 --threads 1 to \x1b]0;title\x07'"


def test_an_older_run_has_no_history(folder: RunFolder) -> None:
    folder.history_file.unlink()
    assert (starts(folder), format_starts(folder), last_launch(folder)) == ([], "", LaunchOptions(folder.path))


@pytest.mark.parametrize(
    ("url", "kept"),
    [
        ("file:redis-url", "file:/redis-url"),
        ("redis://:hush@localhost:1/2", "redis://localhost:1"),
        ("rediss://localhost:1?ssl_certfile=a&ssl_password=hush", "rediss://localhost:1"),
        (None, None),
    ],
)
def test_how_it_was_started_is_kept_but_no_password(
    url: str | None, kept: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir("/")
    options = LaunchOptions(tmp_path / "run", launcher="manual", device="cuda:1", redis_url=url, all_cpus=True)
    folder = open_run(CONFIG, options)
    folder.lock.release()
    assert last_launch(folder) == dataclasses.replace(options, redis_url=kept)
    assert "hush" not in folder.history_file.read_text()
