"""Studies: every run of every scale is one that rmc would take, and one study is run as a user would."""

import dataclasses
import importlib
import json
import os
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

import studies
from rmc.analysis import history
from rmc.cli import parser, run_options, train_options
from rmc.common.errors import ConfigError
from rmc.deploy.run.folder import RESULT, RunFolder
from rmc.deploy.run.validation import validate
from rmc.sweep.pool import Ending
from studies import averaging, generalisation, pybullet, sbx, study
from studies.study import Play, Scale, Study

OTHERS = {"__init__", "drift", "sbx", "study", "t_maze_env"}
NAMES = sorted({path.stem for path in Path(studies.__file__).parent.glob("*.py")} - OTHERS)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("scale", ["smoke", "small", "full"])
def test_every_run_is_one_that_rmc_takes(name, scale):
    imported: Study = importlib.import_module(f"studies.{name}").STUDY
    assert imported.name == name
    jobs = imported.jobs(scale)
    assert len({job.folder for job in jobs}) == len(jobs)
    if scale == "smoke":  # the same words, but for its sizes
        jobs = jobs[:1]
    if scale == "full":  # the same words as of small, but for length, seeds and environments
        jobs = list({job.values["env"]: job for job in reversed(jobs)}.values())
    seen = set()
    for job in jobs:
        assert job.words[job.words.index("--seed") + 1] == str(job.seed)
        if job.seed != jobs[0].seed:  # the same words but for that
            continue
        command = parser.parse(job.command(job.folder))
        assert isinstance(command, train_options.Train | run_options.Baseline)
        assert (command.seed, command.run_dir, command.env.id) == (job.seed, job.folder, job.values["env"])
        config, begins_with = command.config(), None
        if isinstance(command, train_options.Train):
            validate(config)
            begins_with = command.init_from, command.init_parts
        seen.add(repr((dataclasses.replace(config, seed=0), begins_with)))
    assert len(seen) == len(jobs) / len({job.seed for job in jobs})  # no two agents are the same


@pytest.mark.long
def test_a_study_runs_once_and_its_lines_can_be_plotted(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "RUNS", tmp_path)
    agents = {"ours": "train ENV --flicker 0.1", "theirs": "baseline sac ENV --flicker 0.1"}
    tiny = Study("tiny", agents, small=Scale(1000, (1, 2), ("InvertedPendulum-v5",)))
    jobs = tiny.jobs("smoke")
    assert [job.values["agent"] for job in jobs] == ["ours", "theirs"]
    tiny.run("smoke", jobs, at_once=2)
    lines = tmp_path / "tiny-smoke.jsonl"
    histories = history.read_histories(lines)
    assert {one.agent for one in histories} == {"ours", "theirs"}
    assert {one.env for one in histories} == {"InvertedPendulum-v5, flicker 0.1"}
    assert all(one.finished and one.env_steps >= 1200 and one.commit for one in histories)
    before = lines.read_bytes()
    tiny.run("smoke", jobs)
    assert lines.read_bytes() == before
    played = averaging.play(jobs[0], episodes=1)
    plays = iter([{**one.values, "seed": one.seed} for one in jobs])
    for _ in range(2):  # the second time nothing is left to play
        written = tiny.played("smoke", jobs, Play("played", lambda _: next(plays), print)).read_text().splitlines()
        assert [json.loads(line)["agent"] for line in written] == ["ours", "theirs"]
    assert played["env_steps"] == sorted(played["env_steps"]) != []
    assert len(played["averaged"]) == len(played["newest"]) == len(played["env_steps"])
    assert np.isfinite([played["averaged"], played["newest"]]).all()


def test_of_so_many_steps_it_has_runs_and_a_file_of_its_own(tmp_path, monkeypatch):
    begun = []

    def conduct(plan, place, stop, began, ended):
        begun.append(plan.next())
        ended(begun[0], Ending("failed", 1.0, "ended with 1"))

    monkeypatch.setattr(study, "RESULTS", tmp_path)
    monkeypatch.setattr(study, "conduct", conduct)
    tiny = Study("tiny", {"ours": "train ENV"}, small=Scale(1000, (1, 2), ("InvertedPendulum-v5",)))
    monkeypatch.setattr("sys.argv", ["tiny", "--steps", "3000", "--seeds", "4"])
    with pytest.raises(SystemExit, match="ended with 1"):
        tiny.main()
    (job,) = begun
    command = parser.parse(job.command(job.folder))
    assert (command.total_steps, command.seed, command.env.id) == (3000, 4, "InvertedPendulum-v5")
    assert job.folder.parent.name == "tiny-3000"
    assert tiny.results("3000") == tmp_path / "tiny-3000.jsonl"
    assert all("1000" in one.words for one in tiny.jobs("small"))


def test_what_is_played_is_of_the_length_that_was_trained(tmp_path, monkeypatch, capsys):
    """Only finished runs; where there are none, or a file of lines is torn, that is one line."""
    monkeypatch.setattr(study, "RESULTS", tmp_path)
    monkeypatch.setattr(study, "RUNS", tmp_path)
    tiny = Study("tiny", {"ours": "train ENV"}, small=Scale(1000, (1, 2), ("InvertedPendulum-v5",)))
    after = Play("seen", lambda job: {**job.values, "seed": job.seed}, lambda path: print(path))
    monkeypatch.setattr("sys.argv", ["tiny", "--steps", "3000", "--seeds", "2", "3", "--play"])
    with pytest.raises(SystemExit, match="no such run has ended"):
        tiny.main(after)
    tiny.of_steps(3000)
    for job in tiny.jobs("3000", [1, 2]):
        job.folder.mkdir(parents=True)
        RunFolder(job.folder).write_result(dict.fromkeys(RESULT, 3000))
    tiny.main(after)
    lines = tmp_path / "tiny-3000.seen.jsonl"
    assert capsys.readouterr().out.strip() == str(lines)
    assert [json.loads(line)["seed"] for line in lines.read_text().splitlines()] == [2]
    lines.write_text("{")
    with pytest.raises(SystemExit, match=r"tiny-3000\.seen\.jsonl:1"):
        tiny.main(after)
    (tmp_path / "tiny-small.jsonl").write_text("{")
    monkeypatch.setattr("sys.argv", ["tiny"])
    with pytest.raises(SystemExit, match=r"tiny-small\.jsonl:1"):
        tiny.main()


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["--jobs", "0"], "--jobs=0: take at least 1"),
        (["--play", "--scale", "300000"], "invalid choice"),
        (["--draw", "x.png"], "name the files"),
        (["--draw", "x.png", "nofile"], "nofile"),
        (["--draw", "/proc/x.png", "nofile"], "cannot be written"),
    ],
)
def test_what_a_study_cannot_do_is_said(words, fault, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["generalisation", *words])
    with pytest.raises(SystemExit) as ending:
        generalisation.main()
    assert fault in f"{ending.value} {capsys.readouterr().err}"


@pytest.mark.long
def test_a_run_that_fails_is_told_and_the_others_go_on(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "RUNS", tmp_path)
    agents = {"broken": "train ENV --gamma 7", "sound": "baseline sac ENV"}
    tiny = Study("tiny", agents, small=Scale(1000, (1,), ("InvertedPendulum-v5",)))
    with pytest.raises(ConfigError, match="gamma"):
        tiny.run("smoke", tiny.jobs("smoke"))
    (kept,) = (json.loads(line) for line in (tmp_path / "tiny-smoke.jsonl").read_text().splitlines())
    assert kept["agent"] == "sound"


def test_ctrl_c_starts_no_other_run(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(study, "RUNS", tmp_path)
    tiny = Study("tiny", {name: f"train ENV --gamma 0.{name}" for name in "123"})
    monkeypatch.setattr(study, "commit", lambda: os.kill(os.getpid(), signal.SIGINT))  # asked for as a run begins
    with pytest.raises(KeyboardInterrupt):
        tiny.run("smoke", tiny.jobs("smoke"))
    assert capsys.readouterr().out.count("rmc train") == 1
    assert not (tmp_path / "tiny-smoke.jsonl").exists()


def test_results_do_not_change_the_commit_but_code_does(tmp_path):
    def git(*words: str) -> str:
        command = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b", *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    code, lines = tmp_path / "actor.py", tmp_path / "studies" / "results" / "one.jsonl"
    lines.parent.mkdir(parents=True)
    assert not study.commit(lines.parent.parent)
    git("init", "-q")
    code.write_text("1\n")
    lines.write_text("1\n")
    git("add", ".")
    git("commit", "-qm", "first")
    first = git("rev-parse", "--short=7", "HEAD").strip()
    lines.write_text("1\n2\n")
    assert study.commit(lines.parent.parent) == first
    code.write_text("2\n")
    assert study.commit(lines.parent.parent) == first + "+"
    git("add", ".")  # as much where it is staged
    assert study.commit(lines.parent.parent) == first + "+"


def test_a_wrong_agent_is_refused():
    with pytest.raises(ConfigError, match="--only"):
        Study("tiny", {"ours": "train ENV"}).jobs("small", only=["hours"])


def test_an_area_is_over_partial_views_only(tmp_path, capsys):
    """Neither everything seen nor nothing counts."""
    returns = [1e6, *[10.0] * 8, 100.0, -1e6]
    lines = [{"agent": "RMC", "env": "Hopper-v5", "seed": seed, "returns": returns} for seed in (1, 2)]
    (tmp_path / "lines").write_text("\n".join(map(json.dumps, lines)))
    assert generalisation.area(returns) == 20.0
    generalisation.report(tmp_path / "lines")
    assert capsys.readouterr().out == "Hopper-v5, RMC: 20 (20, 20)\n"


def test_averages_are_judged_by_a_runs_second_half(tmp_path, capsys):
    both = {"averaged": [9, 2, 4, 6], "newest": [9, 1, 3, 8]}
    line = {"agent": "RMC", "env": "Hopper-v5", "seed": 1, "env_steps": [10, 20, 30, 40]} | both
    (tmp_path / "lines").write_text(json.dumps(line))
    averaging.report(tmp_path / "lines")
    assert capsys.readouterr().out.splitlines() == [
        "RMC, Hopper-v5, seed 1, averaged: mean 5, worst 4, deviation 1 of 2 checkpoints",
        "RMC, Hopper-v5, seed 1, newest: mean 6, worst 3, deviation 2 of 2 checkpoints",
    ]


def test_how_it_was_played_is_drawn(tmp_path):
    line = {
        "agent": "RMC",
        "env": "Hopper-v5",
        "seed": 1,
        "env_steps": 300,
        "flicker": [0.0, 0.5],
        "returns": [9.0, 4.0],
    }
    (tmp_path / "lines").write_text(json.dumps(line))
    generalisation.draw(tmp_path / "seen.png", [tmp_path / "lines"] * 2)
    assert (tmp_path / "seen.png").read_bytes().startswith(b"\x89PNG")


def test_a_run_may_begin_with_another_agents():
    """Of the same environment and seed, and its job comes before."""
    agents = {"first": "train ENV", "second": "train ENV --init-from 'RUN:first'"}
    jobs = Study("tiny", agents, small=Scale(1000, (1, 2), ("InvertedPendulum-v5",))).jobs("small")
    assert [job.values["agent"] for job in jobs] == ["first", "second"] * 2
    for source, job in zip(jobs[::2], jobs[1::2], strict=True):
        assert job.words[job.words.index("--init-from") + 1] == str(source.folder)
        assert source.seed == job.seed


def test_pybullets_walkers_stand_beside_what_is_public(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(study, "RUNS", tmp_path)
    (job, *_) = pybullet.STUDY.jobs("small")
    job.folder.mkdir(parents=True)
    RunFolder(job.folder).write_result(dict.fromkeys(RESULT, 500_000))
    (tmp_path / "lines").write_text(json.dumps(pybullet.play(job)))
    pybullet.report(tmp_path / "lines")
    assert capsys.readouterr().out.splitlines()[2:] == [
        "| pybullet/AntPositions-v0 | 1 | 500,000 | 500,000 ± 500,000 | 3,045 | 2,597 |"
    ]
    own = pybullet.play(job) | {"env": "pybullet/HopperPositions-v0"}
    (tmp_path / "lines").write_text(json.dumps(own))
    pybullet.report(tmp_path / "lines")
    assert "| – | – |" in capsys.readouterr().out


def test_a_run_of_sbx_is_one_line(tmp_path, monkeypatch):
    """What it prints is another's; here a script prints as much in its place."""
    python = tmp_path / "python"
    said = '{"steps": 100, "updates": 8, "return": 2.5, "std": 0.5}'
    python.write_text(f"#!/bin/sh\n[ $4 = 2 ] && exit 1\necho a warning\necho '{said}'\necho $@ >> {tmp_path}/words\n")
    python.chmod(0o755)
    monkeypatch.setattr(sbx, "peer_python", lambda _: python)
    monkeypatch.setattr(sbx, "RESULTS", tmp_path)
    asked = "--env Hopper-v5 --only TD3 --seeds 1 1 2 --steps 100"
    told = "TD3 Hopper-v5 1 --steps 100 --every 10000 --together 8 --heads 400 300"
    monkeypatch.setattr("sys.argv", ["sbx", *asked.split()])
    with pytest.raises(subprocess.CalledProcessError):
        sbx.main()
    (one,) = history.read_histories(tmp_path / "sbx-100.jsonl")
    assert (one.agent, one.env, one.seed, one.env_steps, one.finished) == ("TD3 of SBX", "Hopper-v5", 1, 100, True)
    assert [(past.return_mean, past.return_std) for past in one.evaluations] == [(2.5, 0.5)]
    (words,) = (tmp_path / "words").read_text().splitlines()
    assert words.split()[1:] == told.split()
