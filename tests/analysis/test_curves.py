"""Histories of runs, and what rmc plot makes of them."""

import dataclasses
import json
import shutil
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from rmc.analysis import curves, history
from rmc.analysis.history import Evaluation, History
from rmc.analysis.run_paths import expanded
from rmc.cli.main import run
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import to_json
from rmc.deploy.run.presets import memory, robust
from tests.command import complaint


def history_of(agent="RMC", env="HalfCheetah-v5", seed=0, last=100.0, initial: float | None = 0.0) -> History:
    evaluations = [Evaluation(1000 * i, 10 * i, 5.0 * i, last * i / 3, 1.0) for i in (1, 2, 3)]
    return History(agent, env, seed, 3000, 30, 15.0, initial, evaluations, True, "abc")


def shown(tables) -> str:
    console = Console(width=curves.WIDTH)
    with console.capture() as text:
        console.print(*tables)
    return text.get()


def test_an_evaluation_has_its_seconds_where_the_clock_went_back():
    times = [(100.0, 5.0), (200.0, 105.0), (20.0, 105.0), (120.0, 205.0)]  # the second start's is behind
    records = [{"role": "launcher", "time": time, "wall_s": wall} for time, wall in times]
    for place, time in ((1, 150.0), (3, 199.0), (5, 70.0), (7, 121.0)):
        records.insert(place, {"role": "evaluator", "time": time})
    assert history.wall_seconds(records)[1::2] == [55.0, 104.0, 155.0, 205.0]
    assert history.wall_seconds([{"role": "actor-0", "time": 7.0}]) == [0.0]


def test_a_table_in_a_pipe_has_every_name_and_digit(tmp_path, capsys):
    runs = [history_of(agent, seed=seed, last=12_345.0) for agent in ("RMC", "RMC --gamma 0.95") for seed in range(4)]
    (tmp_path / "lines").write_text("\n".join(run.to_line() for run in runs))
    assert run(["plot", str(tmp_path / "lines"), "--reference", "RMC", "--out", str(tmp_path / "a.png")]) == 0
    shown = capsys.readouterr().out
    assert "RMC --gamma 0.95" in shown
    assert "12,345 (12,345, 12,345, 12,345, 12,345)" in shown
    assert "\N{HORIZONTAL ELLIPSIS}" not in shown


def test_a_line_holds_a_history():
    line = history_of().to_line()
    assert history._of_line(json.loads(line), "file:1").to_line() == line


def test_a_run_is_read_from_its_folder(tmp_path):
    """Steps and wall time of an evaluation lie between what learner and launcher said around it, resumed or not."""
    config = dataclasses.replace(robust(EnvConfig("Hopper-v5", flicker=0.5)), seed=3)
    config = dataclasses.replace(config, agent=dataclasses.replace(config.agent, head_input="hidden", heads=(5, 6)))
    (tmp_path / "config.json").write_text(to_json(config))
    records = [
        {"role": "launcher", "time": 100.0, "wall_s": 0.0},
        {"role": "learner", "time": 100.0, "updates": 0, "env_steps": 0},
        {"role": "learner", "time": 110.0, "updates": 100, "env_steps": 1000},
        {"role": "launcher", "time": 110.0, "wall_s": 10.0},
        {"role": "evaluator", "time": 105.0, "eval_update": 50, "eval_return_mean": 7.0, "eval_return_std": 1.0},
        {"role": "evaluator", "time": 107.0, "eval_broken_episodes": 5},
        {"role": "launcher", "time": 900.0, "wall_s": 10.0},
        {"role": "evaluator", "time": 905.0, "eval_update": 90, "eval_return_mean": 9.0, "eval_return_std": 1.0},
        {"role": "launcher", "time": 910.0, "wall_s": 20.0},
    ]
    (tmp_path / "metrics.jsonl").write_text("\n".join(map(json.dumps, records)) + '\n{"role": "evalu')
    (past,) = history.read_histories(tmp_path)
    assert past.agent == "RMC --heads 5 6 --head-input hidden"
    assert past.env == "Hopper-v5, flicker 0.5"
    assert (past.seed, past.finished, past.initial_return) == (3, False, None)
    assert past.evaluations == [Evaluation(500, 50, 5.0, 7.0, 1.0), Evaluation(900, 90, 15.0, 9.0, 1.0)]
    result = {"updates": 100, "env_steps": 1000, "wall_s": 21.0, "eval_return_mean": 11.0, "eval_return_std": 2.0}
    result["eval_episodes"] = 10
    (tmp_path / "result.json").write_text(json.dumps({**result, "initial_return_mean": -1.0}))
    (past,) = history.read_histories(tmp_path)
    assert past.evaluations[-1] == Evaluation(1000, 100, 21.0, 11.0, 2.0)
    assert (past.finished, past.initial_return) == (True, -1.0)
    (tmp_path / "result.json").write_text(json.dumps({**result, "updates": 90, "initial_return_mean": -1.0}))
    (past,) = history.read_histories(tmp_path)  # the evaluator has played that checkpoint before
    assert [one.env_steps for one in past.evaluations] == [500, 1000]


def test_an_evaluation_that_was_cut_is_compared_with_no_other(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(to_json(robust("Hopper-v5")))
    played = {"role": "evaluator", "time": 1.0, "eval_update": 50, "eval_env_steps": 500, "eval_return_std": 1.0}
    whole = {"eval_return_mean": -210.0, "eval_cut": 0}
    cut = {"eval_update": 90, "eval_return_mean": -20.0, "eval_cut": 1}
    (tmp_path / "metrics.jsonl").write_text(f"{json.dumps(played | whole)}\n{json.dumps(played | cut)}\n")
    ends = {"updates": 100, "env_steps": 1000, "wall_s": 2.0, "eval_episodes": 10, "initial_return_mean": -5.0}
    (tmp_path / "result.json").write_text(json.dumps(ends | played | cut))
    (tmp_path / "initial.json").write_text(json.dumps(ends | played | cut))
    (past,) = history.read_histories(tmp_path)
    assert [one.return_mean for one in past.evaluations] == [-210.0]
    assert (past.finished, past.initial_return) == (True, None)
    assert (past.env_steps, past.updates, past.wall_s) == (1000, 100, 2.0)  # as long as others that finished


@pytest.mark.timeout(60)
def test_a_week_of_evaluations_is_read_at_once(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(to_json(robust("Hopper-v5")))
    minutes = range(1, 10_001)
    launcher = [{"role": "launcher", "time": 5.0 * at, "wall_s": 2.5 * at} for at in range(12 * len(minutes) + 1)]
    said = {"role": "evaluator", "eval_return_mean": 1.0, "eval_return_std": 0.0}
    played = [said | {"time": 60.0 * at, "eval_update": at, "eval_env_steps": at} for at in minutes]
    lines = sorted(launcher + played, key=lambda line: line["time"])  # the launcher's first, as sorting is stable
    (tmp_path / "metrics.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    (past,) = history.read_histories(tmp_path)
    assert [(one.env_steps, one.wall_s) for one in past.evaluations] == [(at, 30.0 * at) for at in minutes]


def test_of_a_checkpoint_that_was_played_twice_the_last_counts(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(to_json(robust("Hopper-v5")))
    played = {"role": "evaluator", "eval_update": 50, "eval_env_steps": 500, "eval_return_std": 1.0}
    lines = [played | {"time": 1.0 + score, "eval_return_mean": score} for score in (9.0, 7.0)]
    (tmp_path / "metrics.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    (past,) = history.read_histories(tmp_path)
    assert [one.return_mean for one in past.evaluations] == [7.0]


def test_what_was_played_of_steps_that_are_lost_does_not_count(tmp_path: Path) -> None:
    """A run that was killed goes on from its last checkpoint, of fewer steps."""
    (tmp_path / "config.json").write_text(to_json(robust("Hopper-v5")))
    steps = [100, 200, 300, 150, 250]
    played = [{"eval_env_steps": at, "eval_update": at, "eval_return_mean": place} for place, at in enumerate(steps)]
    lines = [{"role": "evaluator", "time": 1.0, "eval_return_std": 1.0} | one for one in played]
    (tmp_path / "metrics.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    (past,) = history.read_histories(tmp_path)
    assert [(one.env_steps, one.return_mean) for one in past.evaluations] == [(100, 0.0), (150, 3.0), (250, 4.0)]


def test_a_warm_start_is_another_agent(tmp_path: Path) -> None:
    """What it began with is no untrained agent's return."""
    (tmp_path / "config.json").write_text(to_json(robust("Hopper-v5")))
    began = {"asked": ["a:7", "policy"], "run": "/runs/a", "checkpoint": 7, "parts": "policy"}
    start = {"time": 1.0, "version": "0.1.0", "env_steps": 0, "init_from": began}
    (tmp_path / "history.jsonl").write_text(json.dumps(start) + "\n")
    assert history.describe(tmp_path).agent == "RMC --init-from /runs/a:7 --init-parts policy"
    runs = [history_of("RMC", last=100.0, initial=0.0), history_of("warm", last=300.0, initial=290.0)]
    warm = next(line for line in shown(curves.tables(curves.grouped(runs), "RMC")).splitlines() if "warm" in line)
    assert warm.split()[-2:] == ["3.00", "1.00"]


def test_a_scaled_return_is_of_the_return_beside_it() -> None:
    """From five seeds on that is the interquartile mean."""
    best = [history_of("best", seed=seed, last=1000.0) for seed in range(5)]
    other = [history_of("other", seed=seed, last=last) for seed, last in enumerate([1000.0] * 4 + [-4000.0])]
    text = shown(curves.tables(curves.grouped([*best, *other]), "best"))
    (line,) = (line.split() for line in text.splitlines() if line.startswith("other"))
    assert (line[2], line[-2]) == ("1,000", "1.00")


def test_names_are_drawn_as_they_are(tmp_path: Path) -> None:
    """A dollar begins no mathematics."""
    runs = [history_of("RMC --init-from a$^$b:1", "of$_$mine:Env-v0")]
    curves.draw(curves.grouped(runs), "env_steps", tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 5_000


def test_what_a_resume_changed_is_another_agent(tmp_path: Path) -> None:
    """Not so what never trained, and what makes no other agent."""
    changed = [
        (0, {"update.gamma": [0.5, 0.99]}),
        (100_032, {"replay.replay_ratio": [96.0, 16.0], "total_steps": [100_000, 300_000]}),
    ]
    starts = [{"time": 1.0, "version": "0", "env_steps": step, "changes": said} for step, said in changed]
    (tmp_path / "history.jsonl").write_text("".join(json.dumps(start) + "\n" for start in starts))
    for ratio, agent in ((16.0, "RMC --replay-ratio 96.0 then 16.0"), (96.0, "RMC")):
        config = robust("Hopper-v5")
        config = dataclasses.replace(config, replay=dataclasses.replace(config.replay, replay_ratio=ratio))
        (tmp_path / "config.json").write_text(to_json(config))
        assert history.describe(tmp_path).agent == agent


def test_what_a_long_run_has_said_is_not_kept(tmp_path):
    (tmp_path / "config.json").write_text(to_json(robust(EnvConfig("Hopper-v5"))))
    said = {"role": "actor-0", "time": 1.0, **{f"metric_{i}": float(i) for i in range(20)}}
    played = {"role": "evaluator", "time": 2.0, "eval_update": 9, "eval_return_mean": 7.0, "eval_return_std": 1.0}
    (tmp_path / "metrics.jsonl").write_text(f"{json.dumps(said)}\n" * 2_000 + f"{json.dumps(played)}\n")
    tracemalloc.start()
    (past,) = history.read_histories(tmp_path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(past.evaluations) == 1
    assert most < 500_000


def test_a_run_is_described_without_its_environment(tmp_path):
    (tmp_path / "config.json").write_text(to_json(memory(EnvConfig("nowhere:X-v0"))))
    assert history.describe(tmp_path).agent == "RMC memory"


def odd(**fields) -> str:
    return json.dumps(dataclasses.asdict(history_of()) | fields)


@pytest.mark.parametrize(
    "text",
    [
        "[1, 2]",
        "{}",
        "not json",
        history_of().to_line()[:-9],
        b"\xff",
        odd(evaluations=[]),
        odd(evaluations=[dataclasses.asdict(Evaluation(1, 1, 1.0, 1.0, 1.0)) | {"return_mean": None}]),
        odd(evaluations=[dataclasses.asdict(Evaluation(1, 1, 1.0, 1.0, 1.0)) | {"return_mean": "abc"}]),
        odd(evaluations=["abc"]),
        odd(initial_return="abc"),
        odd(agent=None),
        odd(other=1),
    ],
)
def test_what_is_no_history_is_refused_where_it_is(text, tmp_path):
    line = text if isinstance(text, bytes) else text.encode()
    (tmp_path / "file.jsonl").write_bytes(history_of().to_line().encode() + b"\n\n" + line)
    with pytest.raises(ConfigError, match=r"RUNS='.*file\.jsonl:3'"):
        history.read_histories(tmp_path / "file.jsonl")


def test_a_run_that_cannot_be_read_is_told_and_left_out(tmp_path, capsys):
    for name, text in {"foreign": "5", "new": to_json(robust(EnvConfig("Hopper-v5")))}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text(text)
    (tmp_path / "lines").write_text(history_of().to_line())
    (tmp_path / "empty").touch()
    paths = {name: str(tmp_path / name) for name in ("foreign", "new", "empty", "lines")}
    assert run(["plot", *paths.values(), "--out", str(tmp_path / "out.png")]) == 0
    assert "100 (100)" in capsys.readouterr().out
    for names, fault in {("foreign",): "an object", ("foreign", "new"): "no history", ("empty",): "no history"}.items():
        assert fault in complaint(["plot", *map(paths.get, names), "--out", str(tmp_path / "out.png")], capsys)
    with pytest.raises(ConfigError, match=str(tmp_path / "foreign")):
        history.read_histories(tmp_path / "foreign")
    assert run(["plot", paths["lines"], "--out", "/proc/out.png"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "--out='/proc/out.png': cannot be written" in captured.err


def test_a_run_counts_once_and_what_differs_is_told_apart(tmp_path):
    """Length, an end that is missing, and a seed's second run each make a line of their own."""
    runs = [history_of(seed=seed) for seed in (1, 2, 3, 4)]
    twice = [dataclasses.replace(run, commit="def") for run in runs]
    again = history_of(seed=1, last=300.0)
    late = [dataclasses.replace(history_of(seed=seed, last=500.0), env_steps=9000 + seed) for seed in (1, 2)]
    cut = dataclasses.replace(history_of(seed=1, last=400.0), finished=False, env_steps=1000)
    groups = curves.grouped([*runs, *twice, *late, again, cut, cut])
    assert {name: [one.seed for one in runs] for name, runs in groups["HalfCheetah-v5"].items()} == {
        "RMC, 3,000 steps": [1, 2, 3, 4],
        "RMC, 3,000 steps, run 2 of its seed": [1],
        "RMC, 9,001 steps": [1, 2],
        "RMC, unfinished, 1,000 steps": [1],
    }
    text = shown(curves.tables(groups, None))
    for cells in ("4  100 (100, 100, 100, 100)", "1                 300 (300)", "9,001 to 9,002", "1, 1 unfinished"):
        assert cells in text
    assert curves._named("RMC, 3,000 steps", groups, "env_steps") == "RMC, 3,000 steps (4 seeds, each a line)"


def test_a_seeds_runs_are_told_apart_in_the_order_given():
    """However far each went beyond its end: they may be one value of ``actors`` after the other."""
    first = [dataclasses.replace(history_of(seed=seed, last=100.0), env_steps=3000 + seed) for seed in (1, 2)]
    second = [dataclasses.replace(history_of(seed=seed, last=200.0), env_steps=3003 - seed) for seed in (1, 2)]
    groups = curves.grouped([*first, *second])["HalfCheetah-v5"]
    assert groups == {"RMC": first, "RMC, run 2 of its seed": second}


def test_the_numbers_that_are_drawn_can_be_had(tmp_path, capsys):
    lines, out = tmp_path / "lines", tmp_path / "numbers.jsonl"
    lines.write_text("".join(f"{history_of(seed=seed).to_line()}\n" for seed in (1, 2)))
    assert run(["plot", str(lines), "--out", str(out)]) == 0
    assert str(out) in capsys.readouterr().out
    assert out.read_text() == lines.read_text()


def test_runs_a_little_longer_are_as_long():
    runs = [
        dataclasses.replace(history_of(seed=seed), env_steps=steps) for seed, steps in enumerate((3000, 3140, 3170))
    ]
    assert [len(same) for same in curves.grouped(runs)["HalfCheetah-v5"].values()] == [2, 1]


def test_runs_that_are_all_alike_keep_their_name():
    groups = curves.grouped([history_of(seed=seed) for seed in (1, 2)])
    assert list(groups["HalfCheetah-v5"]) == ["RMC"]
    late = [
        dataclasses.replace(history_of(seed=1), finished=False),
        dataclasses.replace(history_of(seed=2), finished=False),
    ]
    assert list(curves.grouped(late)["HalfCheetah-v5"]) == ["RMC"]


def test_a_folder_of_runs_at_any_depth_and_a_pattern_can_be_plotted(tmp_path, capsys):
    config = robust(EnvConfig("Hopper-v5"))
    for seed, place in enumerate(("one", "deep/er/two", "deep/three")):
        folder = tmp_path / "runs" / place
        (folder / "checkpoints" / "1").mkdir(parents=True)
        (folder / "config.json").write_text(to_json(dataclasses.replace(config, seed=seed)))
        (folder / "checkpoints" / "1" / "config.json").write_text("{}")  # not looked at
        record = {"role": "evaluator", "time": 1.0, "eval_update": 5, "eval_return_mean": 7.0, "eval_return_std": 1.0}
        (folder / "metrics.jsonl").write_text(json.dumps(record) + "\n")
    (tmp_path / "runs" / "sweep.jsonl").write_text("{}\n")
    (tmp_path / "runs" / "deep" / "three").rename(tmp_path / "elsewhere")
    (tmp_path / "runs" / "deep" / "link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "runs" / "deep" / "around").symlink_to(tmp_path / "runs" / "deep")
    shutil.rmtree(tmp_path / "runs" / "one" / "checkpoints")  # as a copy leaves them out
    (tmp_path / "empty").mkdir()
    out = ["--out", str(tmp_path / "out.png")]
    for words in ([str(tmp_path / "runs")], [str(tmp_path / "runs" / "*")], [str(tmp_path / "runs" / "*")] * 2):
        assert run(["plot", *words, *out]) == 0
        assert "7 (7, 7, 7)" in capsys.readouterr().out
    assert run(["plot", str(tmp_path / "runs" / "d*"), *out]) == 0
    assert "7 (7, 7)" in capsys.readouterr().out
    (tmp_path / "elsewhere" / "metrics.jsonl").unlink()
    (tmp_path / "elsewhere" / "metrics.jsonl").mkdir()  # which nobody can read
    assert run(["plot", str(tmp_path / "runs"), *out]) == 0
    assert "7 (7, 7)" in capsys.readouterr().out
    for words, fault in {"empty": "no run in there", "no*": "matches nothing"}.items():
        assert fault in complaint(["plot", str(tmp_path / words), *out], capsys)


def test_a_folder_of_runs_may_hold_another_programs_config(tmp_path):
    (tmp_path / "config.json").write_text("{}")
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for file in ("config.json", "metrics.jsonl"):
            (tmp_path / name / file).touch()
    assert expanded(tmp_path) == [tmp_path / "a", tmp_path / "b"]
    (tmp_path / "a" / "metrics.jsonl").unlink()
    assert expanded(tmp_path / "a") == [tmp_path / "a"]  # a run that has only begun


def test_a_run_without_an_evaluation_is_refused(tmp_path):
    (tmp_path / "config.json").write_text(to_json(robust(EnvConfig("Hopper-v5"))))
    with pytest.raises(ConfigError, match="no evaluation yet"):
        history.read_histories(tmp_path)


def test_few_seeds_are_lines_and_many_a_band(tmp_path):
    runs = [history_of(seed=seed, last=100.0 + seed) for seed in range(5)] + [
        history_of("SAC", seed=seed) for seed in (2, 1)
    ]
    groups = curves.grouped([*runs, history_of("SAC", "Hopper-v5")])
    assert [one.seed for one in groups["HalfCheetah-v5"]["SAC"]] == [1, 2]
    from matplotlib.figure import Figure

    panel = Figure().subplots()
    few, many = (groups["HalfCheetah-v5"][agent] for agent in ("SAC", "RMC"))
    curves.draw_agent(panel, [curves.curve(run, "env_steps") for run in few], 0)
    assert (len(panel.lines), len(panel.collections)) == (2, 0)
    assert panel.lines[0].get_xdata().tolist() == [0.0, 1000.0, 2000.0, 3000.0]
    panel = Figure().subplots()
    line = curves.draw_agent(panel, [curves.curve(run, "wall_s") for run in many], 0)
    assert (len(panel.lines), len(panel.collections)) == (1, 1)
    assert line.get_ydata()[-1] == pytest.approx(np.mean([101, 102, 103]))
    panel = Figure().subplots()
    curves.draw_agent(panel, [(np.array([float(place)]), np.array([7.0])) for place in range(5)], 0)  # apart
    assert ([line.get_marker() for line in panel.lines], len(panel.collections)) == (["o"] * 5, 0)
    apart = [dataclasses.replace(history_of("X", seed=seed, initial=None), evaluations=[]) for seed in range(5)]
    apart = [dataclasses.replace(run, evaluations=history_of().evaluations[:1]) for run in apart]
    assert "each a line" in curves._named("X", curves.grouped(apart), "env_steps")
    assert "interquartile mean" in curves._named("RMC", groups, "env_steps")
    curves.draw(groups, "updates", tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 10_000


def test_agents_of_one_colour_have_other_dashes_and_long_lines_no_markers():
    panel, short, long = Figure().subplots(), (np.arange(9.0),) * 2, (np.arange(1e4),) * 2
    drawn = [curves.draw_agent(panel, [line], index) for line, index in ((short, 0), (short, 10), (long, 1))]
    looks = [(line.get_color(), line.get_linestyle(), line.get_marker()) for line in drawn]
    assert looks == [("C0", "-", "o"), ("C0", "--", "o"), ("C1", "-", "None")]


def test_a_band_is_drawn_where_all_runs_have_been():
    lines = [(np.array([start, end]), np.array([1.0, 2.0])) for start, end in ((0, 9), (2, 10), (1, 8), (0, 9), (0, 9))]
    line = curves.draw_agent(Figure().subplots(), lines, 0)
    assert [line.get_xdata()[at] for at in (0, -1)] == [2.0, 8.0]


def test_panels_without_an_environment_are_empty(tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: figures.append(self))
    curves.draw(curves.grouped([history_of(env=f"Env{i}-v0") for i in range(4)]), "env_steps", tmp_path / "out.png")
    assert [panel.axison for panel in figures[0].axes] == [True] * 4 + [False] * 2


def test_a_reference_that_learnt_nothing_is_no_scale():
    runs = [history_of("RMC", last=5.0), history_of("SAC", last=0.0)]
    ours = next(line for line in shown(curves.tables(curves.grouped(runs), "SAC")).splitlines() if "RMC" in line)
    assert ours.split()[-1] == "1.00"
    assert "inf" not in ours


def test_a_reference_whose_untrained_return_is_unknown_is_beaten_all_the_same():
    runs = [history_of("RMC", last=5.0), dataclasses.replace(history_of("SAC", last=1.0), initial_return=None)]
    ours = next(line for line in shown(curves.tables(curves.grouped(runs), "SAC")).splitlines() if "RMC" in line)
    assert ours.split()[-1] == "1.00"


def test_the_table_compares_with_a_reference():
    runs = [history_of(seed=s, last=200.0) for s in range(5)] + [
        history_of("SAC", seed=s, last=100.0, initial=50.0) for s in range(2)
    ]
    text = shown(curves.tables(curves.grouped(runs), "SAC"))
    assert "200 [200, 200]" in text
    assert "100 (100, 100)" in text
    ours = next(line for line in text.splitlines() if "RMC" in line)
    assert ours.split()[-2:] == ["3.00", "1.00"]
    with pytest.raises(ConfigError, match="--reference"):
        curves.tables(curves.grouped(runs), "PPO")


def test_an_untrained_agents_return_is_the_mean_over_the_references_seeds():
    runs = [history_of(last=175.0), *(history_of("SAC", seed=s, last=100.0, initial=50.0 * s) for s in range(2))]
    ours = next(line for line in shown(curves.tables(curves.grouped(runs), "SAC")).splitlines() if "RMC" in line)
    assert ours.split()[-2] == "2.00"


def test_the_worst_is_of_the_last_evaluations():
    returns = [-90.0, 5.0, 40.0, 30.0, 10.0, 20.0, 60.0]
    evaluations = [Evaluation(i, i, float(i), score, 0.0) for i, score in enumerate(returns)]
    assert curves.cells([dataclasses.replace(history_of(), evaluations=evaluations)])[2] == "10"


def test_returns_below_one_are_told_apart():
    few = [history_of(seed=s, last=last) for s, last in enumerate((0.46, 0.3, 0.64))]
    text = shown(curves.tables(curves.grouped(few), None))
    assert "0.4667 (0.46, 0.3, 0.64)" in text
    assert " 0.1 " in text  # the worst
    many = [history_of(seed=s, last=0.46) for s in range(5)]
    assert "0.46 [0.46, 0.46]" in shown(curves.tables(curves.grouped(many), None))


def test_the_command_draws_and_prints(tmp_path, capsys):
    lines = tmp_path / "study.jsonl"
    lines.write_text("\n".join(history_of(seed=seed).to_line() for seed in range(2)) + "\n")
    assert run(["plot", str(lines), "--out", str(tmp_path / "out.svg"), "--by", "wall_s"]) == 0
    output = capsys.readouterr().out
    assert "HalfCheetah-v5" in output
    assert "100 (100, 100)" in output
    assert (tmp_path / "out.svg").read_text().startswith("<?xml")


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["plot"], "RUNS"),
        (["plot", "nowhere"], "RUNS"),
        (["plot", "LINES", "--out", "nowhere/out.png"], "--out"),
        (["plot", "LINES", "--out", "out.gif"], "--out"),
        (["plot", "LINES", "--reference", "PPO"], "--reference"),
        (["baseline", "sac", "Nowhere-v0"], "no such environment"),
        (["baseline", "sac", "Hopper-v5", "--total-steps", "-5"], "--total-steps"),
        (["baseline", "sac", "Hopper-v5", "--checkpoint-steps", "0"], "--checkpoint-steps"),
        (["baseline", "sac", "Hopper-v5", "--threads", "0"], "--threads"),
        (["baseline", "dreamer", "Hopper-v5"], "dreamer"),
    ],
)
def test_bad_input_is_one_line_that_names_the_fault(words, fault, tmp_path, capsys):
    (tmp_path / "lines").write_text(history_of().to_line())
    assert run([word.replace("LINES", str(tmp_path / "lines")) for word in words]) == 2
    errors = capsys.readouterr().err
    assert fault in errors
    assert errors.count("\n") == 1


@pytest.mark.parametrize(
    ("counts", "label"),
    [
        ((1,), "1 seed, each a line"),
        ((3, 1), "1 to 3 seeds, each a line"),
        ((5, 5), "5 seeds, interquartile mean, 95 %"),
        ((5, 3), "3 to 5 seeds, each a line or interquartile mean, 95 %"),
    ],
)
def test_the_legend_says_how_many_seeds_its_panels_have(counts, label):
    groups = {f"env {i}": {"RMC": [history_of(seed=seed) for seed in range(count)]} for i, count in enumerate(counts)}
    assert curves._named("RMC", groups, "env_steps") == f"RMC ({label})"
