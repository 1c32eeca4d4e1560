"""The runs below a folder: of every kind and state, the damaged told, none of them fatal."""

import io
import json
import time
from pathlib import Path

import pytest
from rich.console import Console

from rmc.analysis.run_list import RunSummary, runs, summary, table
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import open_run
from rmc.deploy.run.presets import debug
from tests.runs import RESULT


def run_in(path: Path, status: int | None, scores: tuple[float, ...] = ()) -> RunFolder:
    folder = open_run(debug(EnvConfig("InvertedPendulum-v5")), LaunchOptions(path, "fail"))
    records = [
        {"role": "replay", "time": time.time(), "env_steps": 700},
        {"role": "launcher", "time": time.time(), "wall_s": 9.0},
        *({"role": "evaluator", "eval_return_mean": score, "eval_update": 5} for score in scores),
        *({"role": "evaluator", "eval_return_mean": 99.0, "eval_update": 5, "eval_cut": 1} for _ in scores[:1]),
        *({"role": "evaluator", "eval_return_mean": score, "eval_update": 5} for score in scores[-1:]),
    ]
    folder.metrics.write_text("".join(json.dumps(record) + "\n" for record in records))
    folder.lock.release(status)
    return folder


@pytest.fixture
def root(tmp_path: Path) -> Path:
    run_in(tmp_path / "finished", 0).write_result(RESULT)
    run_in(tmp_path / "sweep" / "0001" / "stopped", 130, (20.0, 10.0))
    run_in(tmp_path / "failed", 1)
    baseline = tmp_path / "sac"
    (baseline / "checkpoints").mkdir(parents=True)
    settings = {"algorithm": "sac", "settings": "zoo", "env": {"id": "Hopper-v5"}, "seed": 3, "total_steps": 1000}
    (baseline / "config.json").write_text(json.dumps(settings))
    lines = [{"role": "learner", "env_steps": 400, "updates": 300}, {"role": "launcher", "wall_s": 4.0}]
    (baseline / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (run_in(tmp_path / "torn", 0).path / "config.json").write_text('{"env": {"id"')
    (run_in(tmp_path / "without", 0).path / "config.json").unlink()
    (run_in(tmp_path / "lock", 0).path / ".lock").write_text("ended perhaps")
    run_in(tmp_path / "result", 0).result_file.write_text("[]")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "config.json").write_text("{}")  # of another program
    return tmp_path


def test_every_run_is_found_with_what_became_of_it(root: Path) -> None:
    by_name = {str(Path(one.run).relative_to(root)): one for one in runs(root)}
    states = {name: one.state for name, one in by_name.items()}
    assert states == {
        "failed": "failed", "finished": "finished", "sac": "stopped", "sweep/0001/stopped": "stopped",
        "torn": "damaged", "without": "damaged", "lock": "damaged", "result": "damaged",
    }  # fmt: skip
    stopped = by_name["sweep/0001/stopped"]
    assert (stopped.env_steps, stopped.eval_return, stopped.best_return, stopped.elapsed_s) == (700, 10.0, 20.0, 9.0)
    finished = by_name["finished"]
    assert (finished.env_steps, finished.eval_return, finished.elapsed_s) == (1500, 11.5, 21.0)
    sac = by_name["sac"]
    assert (sac.agent, sac.env, sac.seed, sac.env_steps, sac.total_steps) == ("sac-zoo", "Hopper-v5", 3, 400, 1000)
    for name in ("torn", "without", "lock", "result"):
        fault = by_name[name].fault
        assert fault is not None
        assert str(root / name) in fault
        assert "\n" not in fault


def test_a_run_of_many_actors_has_its_time(tmp_path: Path) -> None:
    """Whose launcher's last word is far from the end."""
    folder = run_in(tmp_path / "run", 0)
    line = json.dumps({"role": "actor-7", "time": time.time(), "more": "x" * 1000})
    with folder.metrics.open("a") as file:
        file.write(f"{line}\n" * 300)
    assert summary(folder.path).elapsed_s == 9.0
    folder.metrics.write_text(f"{line}\n" * 300)
    assert summary(folder.path).elapsed_s is None


def test_a_result_is_the_return_and_not_the_best_where_it_was_cut(tmp_path: Path) -> None:
    folder = run_in(tmp_path / "run", 0, (20.0, 10.0))
    for result in (RESULT, RESULT | {"eval_return_mean": 99.0, "eval_cut": 1}):
        folder.write_result(result)
        one = summary(folder.path)
        assert (one.eval_return, one.best_return) == (result["eval_return_mean"], 20.0)


@pytest.mark.parametrize("width", [40, 80, 120, 250])
def test_the_table_fits_and_says_state_steps_and_return(root: Path, width: int) -> None:
    console = Console(file=io.StringIO(), width=width)
    console.print(table(runs(root), root, width))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert max(map(len, text.splitlines())) <= width
    for shown in ("finished", "1,500", "11.5", "stopped", "700", "damaged", "sac"):
        assert shown in text
    assert ("Hopper-v5" in text) is (width >= 110)


def test_a_folder_without_runs_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="holds no run"):
        runs(tmp_path)
    with pytest.raises(ConfigError, match=r"FOLDER='.*/nowhere': is no folder"):
        runs(tmp_path / "nowhere")


def test_a_folder_that_is_a_run_is_listed_by_its_name(root: Path) -> None:
    (one,) = runs(root / "finished")
    assert (type(one), one.state) == (RunSummary, "finished")
    console = Console(file=io.StringIO(), width=80)
    console.print(table([one], root / "finished", 80))
    assert console.file.getvalue().splitlines()[1].startswith("finished  finished")  # type: ignore[attr-defined]
