"""Searches: what Optuna is told and asked, with real runs and with runs whose metrics are written here."""

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rmc.cli import sweep_check
from rmc.cli.sweep_check import read_job
from rmc.cli.sweep_command import search_work
from rmc.common.errors import ConfigError
from rmc.deploy.run.folder import RunFolder
from rmc.sweep.grid import make_job
from rmc.sweep.index import Index
from rmc.sweep.job import Job
from rmc.sweep.pool import Ending
from rmc.sweep.spec import Range, Search, Spec, read_spec
from tests.command import complaint
from tests.hiding import hide
from tests.sweep.sweeping import ENDLESS, Sweeping, write_spec

TABLE = (
    "[search]\ntrials = 2\n[search.ranges]\nlearning_rate = {low = 1e-4, high = 1e-2, log = true}\nscheme = [1, 3]\n"
)
RANGES: dict[str, Range | list[Any]] = {
    "learning_rate": Range(1e-4, 1e-2, log=True),
    "heads": [[8, 8], [4, 4]],
    "n_step": Range(1, 3),
}


def spec_of(trials: int = 20, **kwargs: Any) -> Spec:
    return Spec(("InvertedPendulum-v5",), words=("--preset", "debug"), search=Search(RANGES, trials, **kwargs))


def work_of(folder: Path, index: Index, spec: Spec) -> Any:
    assert spec.search is not None
    corner = make_job(spec, folder / "trial-0", {}, 0)
    return search_work(spec, spec.search, read_job(corner)[0], index, folder)


def pretend(job: Job, returns: list[float], finished: bool, steps: int = 1000) -> None:
    """The folder of a run that was evaluated every so many steps."""
    config, folder = read_job(job)[0], RunFolder(job.folder)
    job.folder.mkdir(parents=True, exist_ok=True)
    folder.write_config(config)
    records: list[dict[str, Any]] = []
    for at, value in enumerate(returns, 1):
        records.append({"role": "learner", "time": float(at), "updates": 100 * at, "env_steps": steps * at - at})
        evaluated = {"eval_update": 100 * at, "eval_return_mean": value, "eval_return_std": 0.0}
        records.append({"role": "evaluator", "time": float(at), **evaluated})
    folder.metrics.write_text("".join(f"{json.dumps(record)}\n" for record in records))
    if finished:
        numbers = {
            "env_steps": config.total_steps,
            "updates": 100 * len(returns),
            "wall_s": 1.0,
            "eval_return_std": 0.0,
            "eval_episodes": 1,
        }
        folder.write_result({**numbers, "eval_return_mean": returns[-1], "initial_return_mean": 0.0})


def play(work: Any, index: Index, returns: list[float], finished: bool = True) -> Job:
    job = work.plan.next()
    index.begin(job)
    pretend(job, returns, finished)
    if finished:
        ending = Ending("finished", 1.0)
        work.plan.end(job, ending)
        index.end(job, ending)
    return job


@pytest.fixture
def index(tmp_path: Path) -> Iterator[Index]:
    index = Index(tmp_path)
    yield index
    index.close()


def test_values_are_drawn_from_the_ranges_and_a_search_that_goes_on_draws_what_it_would_have(
    tmp_path: Path, index: Index
) -> None:
    work = work_of(tmp_path, index, spec_of(6))
    first = [play(work, index, [float(at)] * 4) for at in range(3)]
    rest = [play(work, index, [float(at)] * 4) for at in range(3, 6)]
    assert work.plan.next() is None
    values = [job.values for job in [*first, *rest]]
    assert len({value["learning_rate"] for value in values}) == 6
    assert all(1e-4 <= value["learning_rate"] <= 1e-2 and value["n_step"] in (1, 2, 3) for value in values)
    assert {json.dumps(value["heads"]) for value in values} == {"[8, 8]", "[4, 4]"}
    assert [job.name for job in work.jobs] == [f"trial-{number}" for number in range(6)]

    for job in rest:
        shutil.rmtree(job.folder)
        del index.lines[job.name]
    again = work_of(tmp_path, index, spec_of(6))
    assert [job.name for job in again.todo] == ["trial-3", "trial-4", "trial-5"]
    assert [play(again, index, [float(at)] * 4).values for at in range(3, 6)] == values[3:]
    index.lines.clear()
    for job in [*first, *rest]:
        shutil.rmtree(job.folder)
    other = work_of(tmp_path, index, spec_of(6, sampler_seed=1))
    assert all(other.plan.next().values not in values for _ in range(5))  # a neighbour's draws are no repetition


def test_trials_to_come_are_not_parsed(tmp_path: Path, index: Index, monkeypatch: pytest.MonkeyPatch) -> None:
    """That takes 80 ms each, and of those to come the folders alone are known."""
    spec, parsed, whole = spec_of(50), [], sweep_check.read_job
    corner = read_job(make_job(spec, tmp_path / "trial-0", {}, 0))[0]
    monkeypatch.setattr(sweep_check, "read_job", lambda job: parsed.append(job) or whole(job))
    assert spec.search is not None
    assert len(search_work(spec, spec.search, corner, index, tmp_path).todo) == 50
    assert not parsed


def test_a_run_below_the_median_is_pruned_once_enough_are_finished(tmp_path: Path, index: Index) -> None:
    work = work_of(tmp_path, index, spec_of())
    for at in range(3):
        play(work, index, [10.0, 20.0, 30.0, 40.0 + at])
    poor = play(work, index, [1.0, 2.0, 3.0], finished=False)
    assert not work.plan.is_hopeless(poor)  # three are too few to judge by
    play(work, index, [10.0, 20.0, 30.0, 40.0])
    assert not work.plan.is_hopeless(poor)  # nothing new was said
    good, begun = (play(work, index, returns, finished=False) for returns in ([11.0, 21.0], [1.0]))
    assert not work.plan.is_hopeless(good)
    assert not work.plan.is_hopeless(begun)  # its first evaluation does not count
    pretend(begun, [1.0, 2.0], finished=False)
    with RunFolder(begun.folder).metrics.open("a") as file:
        file.write('{"role": "evaluator", "eval_return_mean": 2.0}\n')
    assert work.plan.is_hopeless(begun)
    for job, state in ((begun, "pruned"), (poor, "stopped"), (good, "failed")):
        work.plan.end(job, Ending(state, 1.0))
        index.end(job, Ending(state, 1.0))
    again = work_of(tmp_path, index, spec_of(7))  # what is pruned stays so, the others go on
    assert [job.name for job in again.todo] == [poor.name, good.name]
    assert [again.plan.next().values for _ in range(2)] == [poor.values, good.values]
    assert again.plan.is_hopeless(poor)  # by what those of before made on the way
    assert again.plan.next() is None
    assert not work_of(tmp_path, index, spec_of(prune=False)).plan.is_hopeless(good)


def test_an_evaluation_that_was_cut_is_not_what_a_search_looks_for(tmp_path: Path, index: Index) -> None:
    """Of a task that punishes each step it would be the best."""
    work = work_of(tmp_path, index, spec_of())
    job = work.plan.next()
    index.begin(job)
    pretend(job, [-900.0, -800.0], finished=True)
    folder = RunFolder(job.folder)
    folder.write_result((folder.result() or {}) | {"eval_return_mean": -20.0, "eval_cut": 1})
    work.plan.end(job, Ending("finished", 1.0))
    index.end(job, Ending("finished", 1.0))
    assert [trial.value for trial in work.plan._study.trials] == [-800.0]
    assert index.lines[job.name]["return"] == -800.0
    assert index.lines[job.name]["env_steps"] == read_job(job)[0].total_steps
    assert [trial.value for trial in work_of(tmp_path, index, spec_of()).plan._study.trials] == [-800.0]
    lost = work.plan.next()
    pretend(lost, [-20.0], finished=False)
    text = folder.metrics.read_text().splitlines()[-1]
    RunFolder(lost.folder).metrics.write_text(json.dumps(json.loads(text) | {"eval_cut": 1}) + "\n")
    work.plan.end(lost, Ending("finished", 1.0))
    assert [trial.value for trial in work.plan._study.trials] == [-800.0, None]


def test_other_ranges_than_those_of_its_trials_are_refused(tmp_path: Path, index: Index) -> None:
    work = work_of(tmp_path, index, spec_of())
    play(work, index, [1.0] * 4)
    for ranges in ({"learning_rate": Range(0.5, 0.6)}, RANGES | {"n_step": Range(8, 9)}, RANGES | {"scheme": [1]}):
        spec = Spec(("InvertedPendulum-v5",), words=("--preset", "debug"), search=Search(ranges))
        with pytest.raises(ConfigError, match=r"trial-0 has .* which these ranges do not hold"):
            work_of(tmp_path, index, spec)


def test_a_trials_folder_without_its_line_is_not_gone_on_with(tmp_path: Path, index: Index) -> None:
    """As where a damaged line was removed by hand: its networks would count for other values."""
    play(work_of(tmp_path, index, spec_of()), index, [1.0] * 4)
    del index.lines["trial-0"]
    with pytest.raises(ConfigError, match=r"trial-0': sweep.jsonl has no line of it, .*; move it away"):
        work_of(tmp_path, index, spec_of())


def test_a_search_that_goes_on_has_the_options_of_its_trials(tmp_path: Path, index: Index) -> None:
    work = work_of(tmp_path, index, spec_of())
    play(work, index, [1.0] * 4, finished=False)
    spec = Spec(("InvertedPendulum-v5",), words=("--preset", "debug", "--gamma", "0.9"), search=Search(RANGES))
    with pytest.raises(ConfigError, match=r"^--gamma=0.9: the run in .*trial-0 has 0.99; use that"):
        work_of(tmp_path, index, spec)


def test_a_range_is_of_numbers(tmp_path: Path, index: Index) -> None:
    spec = Spec(("InvertedPendulum-v5",), search=Search({"grounding": Range(0, 1)}))
    with pytest.raises(ConfigError, match=r"search\.grounding=True: only numbers have a range"):
        work_of(tmp_path, index, spec)


@pytest.mark.long  # tests/docs/test_sweeps.py runs one, too
def test_a_search_runs_its_trials(tmp_path: Path) -> None:
    folder, spec = tmp_path / "sweep", str(write_spec(tmp_path, TABLE))
    with Sweeping(folder, spec, "--drop-replay") as sweep:
        assert sweep.finish() == 0, sweep.text()
    assert sweep.states() == {"trial-0": "finished", "trial-1": "finished"}
    header, *rows = (line.split() for line in sweep.text().splitlines()[-3:])
    assert header == ["trial", "learning_rate", "scheme", "seeds", "return"]
    assert sorted(row[0] for row in rows) == ["0", "1"]
    assert float(rows[0][-1]) >= float(rows[1][-1])


@pytest.mark.long
def test_a_trial_far_below_the_others_is_stopped_in_order(tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    table = TABLE.replace("trials = 2", "trials = 5")
    path = write_spec(tmp_path, table, **ENDLESS, launcher="local")
    spec, index = read_spec(path, []), Index(folder)
    for number in range(4):
        job = make_job(spec, folder / f"trial-{number}", {"learning_rate": 1e-3, "scheme": 3}, 0)
        pretend(job, [1e6] * 100, finished=True, steps=200)
        index.end(job, Ending("finished", 1.0))
    index.close()
    with Sweeping(folder, str(path)) as sweep:
        assert sweep.finish() == 0, sweep.text()
    assert sweep.states()["trial-4"] == "pruned"
    assert re.search(r"^5 of 5: learning_rate \S+, scheme \d, trial-4: pruned: return ", sweep.text(), re.MULTILINE)
    assert "1 pruned" in sweep.text()
    assert RunFolder(folder / "trial-4").lock.ended() == 130


def test_without_optuna_it_is_said_how_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    hide("optuna", monkeypatch)
    words = ["sweep", str(write_spec(tmp_path, TABLE)), "--sweep-dir", str(tmp_path / "sweep")]
    assert "search='': optuna is missing; pip install" in complaint(words, capsys)
