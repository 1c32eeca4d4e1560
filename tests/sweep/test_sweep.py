"""Sweeps as a user starts, interrupts and repeats them."""

import dataclasses
import errno
import io
import os
import re
import signal
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import psutil
import pytest
from rich.console import Console

from rmc.cli import parser, sweep_command
from rmc.cli.main import run
from rmc.cli.sweep_check import Checked, as_planned, check_jobs, check_values, read_job
from rmc.cli.sweep_command import _count, _warn_of_empty_rings, grid_work, read_sweep
from rmc.common.errors import ConfigError
from rmc.common.process.role import StopSignal
from rmc.common.return_text import return_text
from rmc.deploy.run import config as run_config
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.starts import note_start
from rmc.sweep import local_runs, pool, room
from rmc.sweep.grid import grid_jobs, is_finished
from rmc.sweep.index import Index
from rmc.sweep.job import Job
from rmc.sweep.pool import drop_replay
from rmc.sweep.table import result_table, run_line
from tests.command import complaint
from tests.processes import alive
from tests.runs import untrained
from tests.sweep.sweeping import ENDLESS, Sweeping, write_spec
from tests.waiting import wait_until

SEEDS = (1, 2)
OTHERS = ("seed=1", "seed=2")


def test_a_grid_is_run_once_and_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec, folder = write_spec(tmp_path, "[grid]\nlearning_rate = [3e-4, 1e-3]\n"), tmp_path / "sweep"
    runs = {"learning_rate=0.0003,seed=0": 3e-4, "learning_rate=0.001,seed=0": 1e-3}
    with Sweeping(folder, str(spec), "--drop-replay") as sweep:
        assert sweep.finish() == 0, sweep.text()
        lines, text = sweep.lines(), sweep.text()
    assert text.startswith(f"2 runs in {folder}, 0 over; {min(2, room.cores())} at a time")
    events = re.findall(
        r"^([12] of 2): learning_rate \S+, seed 0: return \S+ after 70[01] steps, \d+ s$", text, re.MULTILINE
    )
    assert events == ["1 of 2", "2 of 2"]
    assert {name: line["values"] for name, line in lines.items()} == {
        name: {"learning_rate": rate} for name, rate in runs.items()
    }
    for name, line in lines.items():
        result = RunFolder(folder / name).result()
        assert result is not None
        assert line["return"] == result["eval_return_mean"]
        assert (line["state"], line["env_steps"], line["seed"]) == ("finished", result["env_steps"], 0)
        assert line["words"].startswith("rmc train InvertedPendulum-v5 --preset=debug --launcher=lockstep")
        assert line["seconds"] > 0.0
        assert not (folder / name / "replay").exists()
    best = max(lines.values(), key=lambda line: line["return"])
    first_row = text.splitlines()[-2].split()
    assert first_row == [f"{best['values']['learning_rate']:.4g}", "1", return_text(best["return"])]

    before = {name: (folder / name / "metrics.jsonl").stat().st_mtime_ns for name in runs}
    assert run(["sweep", str(spec), "--sweep-dir", str(folder)]) == 0  # nothing is left to do
    assert capsys.readouterr().out.splitlines() == text.splitlines()[-3:]
    assert before == {name: (folder / name / "metrics.jsonl").stat().st_mtime_ns for name in runs}
    words = ["sweep", str(spec), "--sweep-dir", str(folder), "--batch-size", "4"]
    assert "--batch-size=4: the run in " in complaint(words, capsys)

    one = str(folder / next(iter(runs)))
    assert run(["evaluate", one, "--episodes", "1"]) == 0
    assert run(["plot", str(folder), "--out", str(tmp_path / "out.png")]) == 0
    output = capsys.readouterr().out
    assert "RMC debug" in output
    assert "--learning-rate 0.001" in output


@pytest.mark.long
def test_a_killed_run_is_told_the_other_goes_on_and_the_same_command_resumes(tmp_path: Path) -> None:
    """A longer one resumes finished runs, too; without their ring, which it says."""
    spec, folder = write_spec(tmp_path, seeds=SEEDS, total_steps=2500), tmp_path / "sweep"
    words = [str(spec), "--jobs", "2"]
    with Sweeping(folder, *words) as sweep:
        sweep.wait_for_updates(*OTHERS)
        victim = sweep.run_process("seed=1")
        assert victim is not None
        victim.kill()
        with Sweeping(folder, *words) as second:  # only one at a time
            assert second.finish(60.0) == 2
            assert "another rmc sweep runs in it" in second.text()
            assert second.text().count("\n") == 1
        assert sweep.finish() == 1
    assert sweep.states() == {"seed=1": "failed", "seed=2": "finished"}
    assert sweep.lines()["seed=1"]["reason"] == f"killed by signal 9; see {folder / 'logs' / 'seed=1.log'}"
    steps = sweep.lines()["seed=1"]["env_steps"]
    with Sweeping(folder, *words, "--total-steps", "2600", "--drop-replay") as sweep:
        assert sweep.finish() == 0, sweep.text()
    assert "without their replay ring" not in sweep.text()  # it is dropped after the run, not before
    assert steps < 2500
    assert all(line["env_steps"] >= 2600 for line in sweep.lines().values())
    log = (folder / "logs" / "seed=1.log").read_text()
    assert log.count("run folder") == 2
    with Sweeping(folder, *words, "--total-steps", "2700") as sweep:
        assert sweep.finish() == 0, sweep.text()
    assert "without their replay ring, these continue with --warmup-steps that are not trained on: seed=1, seed=2" in (
        sweep.text()
    )


def test_a_run_that_fails_is_told_with_its_last_words(tmp_path: Path) -> None:
    """As where its folder has something else in it."""
    spec, folder = write_spec(tmp_path, seeds=SEEDS), tmp_path / "sweep"
    (folder / "seed=1").mkdir(parents=True)
    (folder / "seed=1" / "thesis.tex").touch()
    with Sweeping(folder, str(spec)) as sweep:
        assert sweep.finish() == 1
    assert sweep.states() == {"seed=1": "failed", "seed=2": "finished"}
    assert re.search(
        r"^\d of 2: seed 1: failed: .*is no run's folder; give another one; see ", sweep.text(), re.MULTILINE
    )
    assert "1 failed" in sweep.text()
    assert "1 not finished; the same command continues them; " in sweep.text()
    assert (folder / "seed=1" / "thesis.tex").exists()


def test_ctrl_c_ends_all_in_order_and_a_kill_leaves_nothing(tmp_path: Path) -> None:
    """Of a run that has roles, and of one that has none."""
    both = '[grid]\nlauncher = ["local", "lockstep"]\n'
    spec, folder = write_spec(tmp_path, both, seeds=SEEDS, **ENDLESS, launcher=None), tmp_path / "sweep"
    first, later = ([f"launcher={one},seed={seed}" for one in ("local", "lockstep")] for seed in SEEDS)
    words = [str(spec), "--jobs", "2"]
    with Sweeping(folder, *words) as sweep:
        sweep.wait_for_updates(*first)
        processes = psutil.Process(sweep.process.pid).children(recursive=True)
        assert sweep.interrupt() == 130
        assert not alive(processes)
        assert sweep.states() == dict.fromkeys(first, "stopped") | dict.fromkeys(later, "waiting")
    for name in first:
        assert RunFolder(folder / name).lock.ended() == 130  # it has saved
        assert max((folder / name / "checkpoints").glob("[0-9]*")).is_dir()
    with Sweeping(folder, *words) as sweep:
        sweep.wait_for(lambda: all(sweep.run_process(name) for name in first))
        processes = psutil.Process(sweep.process.pid).children(recursive=True)
        assert len(processes) >= 2
        sweep.process.kill()
        sweep.process.wait()
        wait_until(lambda: not alive(processes), said=lambda: alive(processes))


class Ended(SimpleNamespace):
    """A run that is over."""

    def status(self) -> int | None:
        return 0


class Saving:
    """A run that needs a moment to save once it is asked to end."""

    def __init__(self) -> None:
        self.done: list[str] = []

    def stop(self) -> None:
        self.done.append("stop")

    def status(self) -> int | None:
        looks = self.done.count("look")
        self.done += ["look"] if "stop" in self.done else []
        return 130 if looks >= 2 else None

    def kill(self) -> None:
        self.done.append("kill")

    def last_words(self) -> str:
        return ""


def test_a_full_disk_ends_a_sweep_but_its_runs_save_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "LOOK_SECONDS", 0.01)
    jobs = [Job(tmp_path / str(number), ("train", "Pendulum-v1"), number) for number in range(2)]
    at_work = [Saving() for _ in jobs]
    plan = SimpleNamespace(next=lambda: jobs.pop(0) if jobs else None, is_hopeless=lambda _: False)
    place = SimpleNamespace(has_room=lambda: True, start=lambda job: at_work[job.seed])

    def begun(job: Job) -> None:
        if job.seed == 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OSError, match="No space left"):
        pool.conduct(cast(Any, plan), cast(Any, place), StopSignal(), begun, lambda *_: None)
    assert at_work[0].done[0] == "stop"
    assert "kill" not in at_work[0].done
    assert at_work[1].done == []


def test_one_that_cannot_be_started_fails_alone(tmp_path: Path) -> None:
    jobs, endings = [Job(tmp_path / f"seed={seed}", ("train", "Pendulum-v1"), seed) for seed in SEEDS], {}

    def start(job: Job) -> Ended:
        if job.seed == 1:
            raise ConfigError("--run-dir", str(job.folder), "this run is being trained")
        return Ended()

    plan = SimpleNamespace(next=lambda: jobs.pop(0) if jobs else None, is_hopeless=lambda _: False, end=lambda *_: None)
    place = SimpleNamespace(has_room=lambda: True, start=start)
    pool.conduct(
        cast(Any, plan),
        cast(Any, place),
        StopSignal(),
        lambda _: None,
        lambda job, how: endings.update({job.seed: how}),
    )
    assert {seed: ending.state for seed, ending in endings.items()} == {1: "failed", 2: "finished"}
    assert "this run is being trained" in endings[1].reason


def test_one_that_does_not_end_in_time_is_killed(tmp_path: Path) -> None:
    run = Saving()
    one = pool._AtWork(Job(tmp_path / "trial-0", (), 0), cast(Any, run), 0.0)
    one.stop()
    one.stop()
    assert run.done == ["stop"]
    one.deadline = 0.0
    one.stop()
    assert run.done == ["stop", "kill"]


@pytest.mark.parametrize("status", [pool.STOPPED_STATUS, -signal.SIGTERM, 1])
def test_what_is_stopped_as_hopeless_is_over_however_early_that_was(tmp_path: Path, status: int) -> None:
    """Asked while it still imports, a run cannot save, and would be started and stopped for ever."""
    one = pool._AtWork(Job(tmp_path / "trial-0", (), 0), cast(Any, Saving()), 0.0, hopeless=True)
    one.stop()
    assert one.ending(status).state == "pruned"
    assert "pruned" in pool.OVER


def test_a_run_that_was_trained_for_longer_is_no_result_of_fewer_steps(tmp_path: Path) -> None:
    job = made(tmp_path / "sweep" / "seed=0")
    config, options = read_job(job)
    fewer = dataclasses.replace(config, total_steps=config.total_steps - 1)
    with pytest.raises(ConfigError, match=r"^--total-steps=3999: the run in .*seed=0 has 4000; use that or more, or"):
        is_finished(job, fewer, options)


def test_a_last_evaluation_that_was_cut_is_played_again_with_more_time(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """With the same time it would be cut again; where other options differ the run could not go on."""
    job = made(tmp_path / "sweep" / "seed=0")
    folder = RunFolder(job.folder)
    folder.write_result({**(folder.result() or {}), "eval_cut": 1})
    config, options = read_job(job)
    assert is_finished(job, config, options)
    longer = dataclasses.replace(config, evaluator=dataclasses.replace(config.evaluator, evaluation_seconds=900.0))
    assert not is_finished(job, longer, options)
    assert is_finished(job, dataclasses.replace(longer, actors=2), options)
    (folder.checkpoints / "epoch").write_text("1")
    _warn_of_empty_rings([job])
    assert not caplog.records  # nothing more is trained
    more = dataclasses.replace(job, words=(*job.words, "--total-steps", "9999999"))
    _warn_of_empty_rings([more])
    assert "these continue with --warmup-steps that are not trained on: seed=0" in caplog.text
    with closing(Index(job.folder.parent)) as index:
        index.put(job, "finished")
        assert run_line(job, index) == (
            "gamma 0.99, seed 0: 0 s; that is an earlier evaluation, as the last one was cut or broke; "
            "a larger --evaluation-seconds plays it again"
        )


def test_a_start_that_nobody_saw_the_end_of_has_its_seconds(tmp_path: Path) -> None:
    """As that of a sweep that was killed."""
    job = made(tmp_path / "sweep" / "seed=0")
    with closing(Index(job.folder.parent)) as index:
        index.put(job, "finished", 0.5)
        assert index.lines[job.name]["seconds"] == 1.0
        index.put(job, "finished", 7.0)
        assert index.lines[job.name]["seconds"] == 8.0


def test_runs_that_began_with_nothing_are_no_results_of_a_warm_start(tmp_path: Path, capsys) -> None:
    job = made(tmp_path / "sweep" / "seed=0")
    config, options = read_job(job)
    assert is_finished(job, config, options)
    with pytest.raises(ConfigError, match=r"^--init-from='x': the run in .*seed=0 began with nothing of another; use"):
        is_finished(job, config, dataclasses.replace(options, init_from="x"))


def test_the_start_that_runs_began_with_is_named_as_it_was_typed(tmp_path: Path) -> None:
    job = made(tmp_path / "sweep" / "seed=0")
    config, options = read_job(job)
    origin = {"run": "/elsewhere/first", "checkpoint": 7, "parts": "all", "asked": ["runs/first", "all"]}
    note_start(RunFolder(job.folder), {}, options, origin)
    assert is_finished(job, config, dataclasses.replace(options, init_from="runs/first"))
    with pytest.raises(ConfigError, match=r"began with --init-from runs/first --init-parts all; use that, or another"):
        is_finished(job, config, dataclasses.replace(options, init_from="./runs/first"))


def test_a_run_that_goes_on_takes_what_the_sweep_planned_and_not_what_it_had(tmp_path: Path) -> None:
    job = made(tmp_path / "sweep" / "seed=0")
    folder = RunFolder(job.folder)
    config, options = read_job(job)
    had = dataclasses.replace(config, actors=4, learner=dataclasses.replace(config.learner, threads=8))
    folder.write_config(had)
    note_start(folder, {}, LaunchOptions(folder.path, launcher="lockstep", device="cuda"), None)
    planned = as_planned(job, config, options)
    command = parser.parse(planned.command(job.folder))
    assert (command.config(), command.launcher, command.device) == (config, "local", "cpu")
    said = dataclasses.replace(job, words=(*job.words, "--actors=2", "--total_steps", "9000"))
    assert as_planned(said, config, options).words.count("--actors") == 0
    assert "--total-steps" not in as_planned(said, config, options).words


def test_lockstep_is_the_launcher_of_every_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planned: list[Any] = []
    monkeypatch.setattr(sweep_command, "_conduct", lambda command, work, checked, index: planned.extend(checked) or 0)
    words = ["InvertedPendulum-v5", "--preset", "debug", "--seeds", "1-2", "--sweep-dir", str(tmp_path / "sweep")]
    assert run(["sweep", *words, "--launcher", "lockstep"]) == 0
    assert [one.options.launcher for one in planned] == ["lockstep", "lockstep"]


def test_a_grid_of_launchers_is_one_of_runs(tmp_path: Path) -> None:
    spec = read_sweep(
        parser.parse(["sweep", "InvertedPendulum-v5", "--preset", "debug", "--grid", "launcher=local,lockstep"])
    )
    check_values(spec, on_this_machine=True)
    launchers = [read_job(job)[1].launcher for job in grid_jobs(spec, tmp_path)]
    assert launchers == ["local", "lockstep"]


def test_a_killed_sweeps_runs_are_not_told_as_running_and_tables_are_not_cut(tmp_path: Path) -> None:
    with closing(Index(tmp_path / "sweep")) as index:
        jobs = [made(tmp_path / "sweep" / f"{at}", gamma) for at, gamma in enumerate((0.99991, 0.99992))]
        index.put(jobs[0], "running")
        jobs[0].folder.joinpath("result.json").unlink()
        grid_work([Checked(job, *read_job(job)) for job in jobs], index)
        assert [index.state(job) for job in jobs] == ["waiting", "finished"]
        console = Console(file=io.StringIO(), width=1_000)
        console.print(result_table(jobs, index))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "0.99991" in text
    assert "0.99992" in text


def test_a_runs_seconds_are_of_all_its_starts(tmp_path: Path) -> None:
    job = made(tmp_path / "sweep" / "0")
    for state, seconds in (("stopped", 1.5), ("finished", 2.0)):
        with closing(Index(tmp_path / "sweep")) as index:
            index.begin(job)
            index.end(job, pool.Ending(cast(Any, state), seconds))
            total = index.lines[job.name]["seconds"]
    assert total == 1.0 + 1.5 + 2.0  # it was trained for a second before


def test_an_index_whose_values_are_none_is_refused(tmp_path: Path) -> None:
    with closing(Index(tmp_path)) as index:
        index.put(Job(tmp_path / "trial-0", (), 0, {"gamma": 0.99}), "waiting")
        index.write()
    lines = tmp_path / "sweep.jsonl"
    lines.write_text(lines.read_text().replace('{"gamma": 0.99}', "5"))
    with pytest.raises(ConfigError, match=r"^sweep.jsonl trial-0=5: its values must be an object; fix or remove its"):
        Index(tmp_path)


def test_one_run_on_one_core_is_told_as_one() -> None:
    assert [_count(1, "run"), _count(2, "run"), _count(1, "core")] == ["1 run", "2 runs", "1 core"]


def test_seeds_deviate_as_a_sample_does(tmp_path: Path) -> None:
    jobs = [Job(tmp_path / str(seed), (), seed, {"gamma": 0.99}) for seed in range(2)]
    with closing(Index(tmp_path)) as index:
        for job in jobs:
            index.put(job, "finished")
            index.lines[job.name] |= {"return": 0.46 + 0.08 * job.seed, "env_steps": 600, "seconds": 3.0}
        words = [run_line(job, index) for job in jobs]
        (cell,) = next(column.cells for column in result_table(jobs, index).columns if column.header == "return")
    assert cell == "0.5000 ± 0.0566"
    assert [line.partition(" after")[0].partition(": ")[2] for line in words] == ["return 0.46", "return 0.54"]


def test_a_table_is_by_environment_and_best_first_there(tmp_path: Path) -> None:
    points = [{"env": env, "scheme": scheme} for env in ("Hopper-v5", "Ant-v5") for scheme in (1, 3)]
    jobs = [Job(tmp_path / str(at), (), 0, values) for at, values in enumerate(points)]
    with closing(Index(tmp_path)) as index:
        for job, mean in zip(jobs, (10.0, 30.0, 40.0, 20.0), strict=True):
            index.put(job, "finished")
            index.lines[job.name]["return"] = mean
        columns = result_table(jobs, index).columns
    cells = {column.header: list(column.cells) for column in columns}
    assert cells["env"] == ["Hopper-v5", "Hopper-v5", "Ant-v5", "Ant-v5"]
    assert cells["scheme"] == ["3", "1", "1", "3"]


def test_a_trials_values_stand_under_their_names(tmp_path: Path) -> None:
    """In whatever order its command gave them."""
    jobs = [
        Job(tmp_path / f"trial-{number}", (), 0, values)
        for number, values in enumerate([{"gamma": 0.99, "polyak": 0.995}, {"polyak": 0.98, "gamma": 0.95}])
    ]
    with closing(Index(tmp_path)) as index:
        columns = result_table(jobs, index).columns
    cells = {column.header: list(column.cells) for column in columns}
    assert (cells["gamma"], cells["polyak"]) == (["0.99", "0.95"], ["0.995", "0.98"])


def test_the_environment_is_made_once_for_all_seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, env_layout = [], run_config.env_layout
    monkeypatch.setattr(run_config, "env_layout", lambda *words: made.append(words) or env_layout(*words))
    words = ("train", "InvertedPendulum-v5", "--preset", "debug")
    jobs = [Job(tmp_path / str(seed), words, seed) for seed in range(3)]
    checked = check_jobs(jobs, on_this_machine=True)
    assert [one.config.seed for one in checked] == [0, 1, 2]
    assert len({one.config.window_spec() for one in checked}) == len(made) == 1


def test_a_run_that_is_there_goes_on_with_what_a_new_one_has_no_use_for(tmp_path: Path) -> None:
    words = ("train", "InvertedPendulum-v5", "--preset", "debug", "--flicker-burst", "5")
    with pytest.raises(ConfigError, match="--flicker-burst"):
        check_jobs([Job(tmp_path / "run", words, 0)], on_this_machine=True)
    folder = untrained(tmp_path / "run", read_job(Job(Path(), words[:4], 0))[0])
    folder.write_config(read_job(Job(Path(), words, 0))[0])
    assert check_jobs([Job(tmp_path / "run", words, 0)], on_this_machine=True)[0].config.env.flicker_burst == 5.0


def made(folder: Path, gamma: float = 0.99) -> Job:
    """A run that is over."""
    words = ("train", "InvertedPendulum-v5", "--preset", "debug", "--gamma", str(gamma), "--seed", "0")
    job = Job(folder, words, 0, {"gamma": gamma})
    config = read_job(job)[0]
    run_folder = untrained(folder, config)
    result = {"updates": 1, "wall_s": 1.0, "eval_return_mean": 12_345.6, "eval_return_std": 0.0, "eval_episodes": 1}
    run_folder.write_result({**result, "env_steps": config.total_steps, "initial_return_mean": 0.0})
    return job


def test_cores_are_shared_out() -> None:
    mine = os.sched_getaffinity(0)
    for count in (1, len(mine), len(mine) + 1):
        parts = local_runs.core_parts(count)
        assert len(parts) == count
        assert set().union(*parts) == mine
        assert count > len(mine) or sum(map(len, parts)) == len(mine)
    assert [room.evenly(runs, 16) for runs in (1, 16, 17, 20, 33)] == [1, 16, 9, 10, 11]
    assert room.runs_that_fit(1, 1 << 60) == 1
    assert room.runs_that_fit(1, 1) == len(mine)
    assert room.runs_that_fit(2 * len(mine), 1) == 1


def test_rings_that_the_disk_cannot_hold_are_refused(tmp_path: Path) -> None:
    jobs = [Job(tmp_path / f"seed={seed}", (), seed) for seed in range(3)]
    free = 1 << 45
    with pytest.raises(ConfigError, match=r"3 rings take .* are free; take --drop-replay"):
        room.check_disk(tmp_path, jobs, free, 1, dropped=False)
    with pytest.raises(ConfigError, match=r"1 rings take .* take fewer --jobs"):
        room.check_disk(tmp_path, jobs, free, 1, dropped=True)
    for job, ring in zip(jobs, ("replay", "replay-0", "replay-1"), strict=True):
        (job.folder / ring).mkdir(parents=True)
    room.check_disk(tmp_path, jobs, free, 1, dropped=False)


def test_the_rings_of_all_replay_servers_are_dropped(tmp_path: Path) -> None:
    job = Job(tmp_path, (), 0)
    for name in ("replay", "replay-0", "replay-11", "replay-counters", "checkpoints"):
        (tmp_path / name).mkdir()
    run = RunFolder(tmp_path)
    run.lock.take()
    drop_replay(job)
    assert (tmp_path / "replay").is_dir()  # somebody trains it longer
    run.lock.release()
    (tmp_path / ".lock").unlink()
    drop_replay(job)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoints", "replay-counters"]


def test_a_sweep_in_a_runs_folder_or_with_a_damaged_index_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = str(write_spec(tmp_path))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text("{}")
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "sweep.jsonl").write_text('{"run": "seed=0"')
    (tmp_path / "file").touch()
    for name, fault in {"run": "is a run's folder", "torn": "sweep.jsonl:1", "file": "cannot be used"}.items():
        assert fault in complaint(["sweep", spec, "--sweep-dir", str(tmp_path / name)], capsys)


def test_a_stop_signal_before_a_run_trains_ends_it_too(tmp_path: Path) -> None:
    spec = write_spec(tmp_path, launcher="local")
    with Sweeping(tmp_path / "sweep", str(spec)) as sweep:
        sweep.wait_for(lambda: sweep.run_process("seed=0"))
        sweep.process.send_signal(signal.SIGTERM)
        assert sweep.finish(60.0) == 130
    assert sweep.states() == {"seed=0": "stopped"}
