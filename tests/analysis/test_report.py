"""rmc report: one page that a real browser shows without a network, of every kind of run."""

import json
import os
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rmc.analysis import baseline_settings, doctor, report, report_figures, report_run, video
from rmc.analysis.curves import HEADINGS
from rmc.analysis.history import Evaluation, History
from rmc.analysis.report_run import DRAWN, ReportRun
from rmc.cli.main import run
from rmc.common.checkpoint import CheckpointFolder
from rmc.deploy.local import trial
from rmc.deploy.run.folder import RunFolder
from tests.analysis import browser
from tests.docs.running import DOCS, commands, ran
from tests.hiding import hide

BROWSER_SECONDS = 60
LEARNT_SECONDS = 0.5  # that the short run has, however fast the machine
PROBE = """<script>
const say = (name, value) => document.documentElement.setAttribute("data-" + name, value);
const videos = [...document.querySelectorAll("video")];
addEventListener("load", () => {
  say("broken", [...document.images].filter(image => !image.naturalWidth).length);
  say("overflow", document.documentElement.scrollWidth - document.documentElement.clientWidth);
  say("videos", videos.filter(video => video.readyState >= 1 && video.duration > 0).length);
});
</script>"""
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short real run of processes, seed 0."""
    path = tmp_path_factory.mktemp("runs") / "seed-0"
    words = ["--preset", "debug", "--total-steps", "2000", "--replay-ratio", "40", "--run-dir", str(path)]
    ran(path.parent, "train", "InvertedPendulum-v5", *words)
    return path


@pytest.fixture
def other(trained: Path, tmp_path: Path) -> Path:
    """The same as of another seed and length."""
    path = tmp_path / "seed-1"
    shutil.copytree(trained, path)
    config = json.loads((path / "config.json").read_text())
    config["seed"], config["total_steps"] = 1, 1600
    (path / "config.json").write_text(json.dumps(config))
    return path


def test_the_commands_of_its_page_and_of_the_doctors_run(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As docs/report.md and docs/doctor.md print them."""
    monkeypatch.setattr(doctor, "LEAST_SECONDS", LEARNT_SECONDS)
    monkeypatch.setattr(trial, "TRAINED_SECONDS", 2.0)
    for name in ("first", "second"):
        shutil.copytree(trained, tmp_path / "runs" / name)
    of_report, of_doctor = ((DOCS / name).read_text() for name in ("report.md", "doctor.md"))
    printed = [*commands(of_report), *commands(of_doctor)]
    assert [words[0] for words in printed] == ["report", "report", "doctor", "train"]
    outputs = [ran(tmp_path, *words) for words in printed]
    assert outputs[0].startswith("report.html: 1 run, ")
    assert outputs[1].startswith("both.html: 2 runs, ")
    assert "learner-bound: actors waited " in outputs[2]
    assert outputs[3].splitlines()[-1] == "it fits"
    rows = re.findall(r"^\| (memory|disk|bandwidth|file handles|threads|time to the end)\b", of_doctor, re.MULTILINE)
    assert rows
    assert [row for row in rows if row not in outputs[3]] == []


class Links(HTMLParser):
    """Everything of a page that a browser would fetch."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.feed(text)
        self.targets += re.findall(r"url\(([^)]*)\)|@import", text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.targets += [
            value or "" for name, value in attributes if name in ("src", "href", "srcset", "data", "poster")
        ]


def written(out: Path, *words: str) -> str:
    assert run(["report", *words, "--out", str(out)]) == 0
    return out.read_text()


def opened(page: Path, width: int, tmp_path: Path) -> dict[str, int]:
    """What a browser without a network says of the page: broken images, pixels too wide, videos that play."""
    probed = tmp_path / f"probed-{width}.html"
    probed.write_text(page.read_text().replace("</body>", f"{PROBE}</body>"))
    words = browser.command(
        tmp_path / "profile", "--proxy-server=127.0.0.1:9", f"--window-size={width},900", "--virtual-time-budget=5000",
        "--dump-dom", probed.as_uri(),
    )  # fmt: skip
    done = subprocess.run(words, capture_output=True, text=True, timeout=BROWSER_SECONDS, check=False)
    assert done.returncode == 0, done.stderr
    assert "CONSOLE" not in done.stderr, done.stderr
    head = done.stdout[: done.stdout.index("<head>")]
    return {name: int(value) for name, value in re.findall(r'data-(\w+)="(-?\d+)"', head)}


def test_a_browser_shows_it_without_a_network(
    trained: Path, other: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "LEAST_SECONDS", LEARNT_SECONDS)
    page = tmp_path / "report.html"
    text = written(page, str(trained), str(other))
    links = Links(text).targets
    assert all(link.startswith("data:") for link in links)
    assert sum(link.startswith("data:image/svg+xml") for link in links) >= 2 + 2 * 4  # curves; each run's figures
    assert "Report of 2 runs" in text
    for heading in ("Returns", "The newest policy", "World-model rollouts", "How each run went", "Config differences"):
        assert f"<h2>{heading}</h2>" in text
    assert re.search(r"<code>--total-steps</code></td><td>2 000</td><td>1 600</td>", text)
    assert '<p class="finding">learner-bound: actors waited' in text
    films = text.count("<video")
    assert films == 1 or "No video: nothing here can render" in text
    for width in (1280, 500):
        assert opened(page, width, tmp_path) == {"broken": 0, "overflow": 0, "videos": films}


def test_the_table_is_of_all_runs_of_an_agent(trained: Path, other: Path) -> None:
    evaluations = [[Evaluation(100, 10, 1.0, 5.0, 0.0), Evaluation(200, 20, 2.0, mean, 0.0)] for mean in (10.0, 20.0)]
    past = [History("RMC", "E", seed, 200, 20, 2.0, 0.0, scores, True) for seed, scores in enumerate(evaluations)]
    (row,) = report._returns(past)[0]["final"]
    assert dict(zip(HEADINGS, row, strict=True)) == {
        "agent": "RMC", "seeds": "2", "return": "15 (10, 20)", "worst of last 5": "5", "steps": "200", "updates": "20",
        "wall s": "2",
    }  # fmt: skip
    runs = [ReportRun.read(path) for path in (trained, other)]
    assert {run.about.agent for run in runs} == {"RMC debug --replay-ratio 40.0"}
    assert len(report.newest(runs)) == 1  # of an agent one policy is played


def test_runs_of_one_name_are_told_apart(trained: Path, tmp_path: Path) -> None:
    for place in ("a", "b"):
        shutil.copytree(trained, tmp_path / place / "run")
    runs = report_run.told_apart([ReportRun.read(tmp_path / place / "run") for place in ("a", "b")])
    assert [run.name for run in runs] == ["a/run", "b/run"]
    assert report_run.told_apart(runs[:1])[0].name == "run"


def test_a_finished_run_without_metrics_has_its_steps(trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path / "run")
    (tmp_path / "run" / "metrics.jsonl").unlink()
    assert ReportRun.read(tmp_path / "run").env_steps == json.loads((trained / "result.json").read_text())["env_steps"]


def test_of_a_record_what_is_drawn_is_kept_and_findings_are_the_doctors(trained: Path) -> None:
    """A long run's whole records do not fit in memory."""
    read = ReportRun.read(trained)
    assert set().union(*read.records) <= DRAWN | {"trained_s"}
    assert {metric for _, _, lines in report.CHARTS for _, metric in lines.values()} <= DRAWN
    assert read.findings == [str(one) for one in doctor.examine(list(read.folder.records()), read.folder.config())]


def test_a_role_may_wait_for_what_looks_like_mathematics(trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path / "run")
    metrics = tmp_path / "run" / "metrics.jsonl"
    metrics.write_text(metrics.read_text().replace('"waiting_for": "credit"', r'"waiting_for": "$\\foo$"'))
    figure = report_figures.waits(ReportRun.read(tmp_path / "run"))
    assert figure is not None
    assert figure.startswith("data:image/svg+xml")


def test_all_replay_servers_count_in_the_throughput(trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path / "run")
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    config["replay"]["replay_shards"] = 2
    (tmp_path / "run" / "config.json").write_text(json.dumps(config))
    rates = [{"role": f"replay-{shard}", "time": 1.0, "env_steps_per_s": 100.0} for shard in (0, 1)]
    (tmp_path / "run" / "metrics.jsonl").write_text("".join(f"{json.dumps(rate)}\n" for rate in rates))
    assert ReportRun.read(tmp_path / "run").series("replay", "env_steps_per_s")[1] == [200.0, 200.0]


def test_wall_time_goes_over_all_starts(trained: Path, tmp_path: Path) -> None:
    path = tmp_path / "run"
    path.mkdir()
    shutil.copy(trained / "config.json", path)
    times = [(100.0, 1.0), (110.0, 11.0), (500.0, 11.0), (510.0, 21.0)]
    lines = [{"role": "launcher", "time": time, "wall_s": wall} for time, wall in times]
    said = [{"role": "learner", "time": time, "updates_per_s": 2.0} for time in (99.5, 105.0, 300.0, 505.0)]
    lines = [line for pair in zip(said, lines, strict=True) for line in pair]
    (path / "metrics.jsonl").write_text("".join(f"{json.dumps(one)}\n" for one in lines))
    places, values = ReportRun.read(path).series("learner", "updates_per_s")
    np.testing.assert_allclose(places, [0.5, 6.0, 11.0, 16.0])
    assert values == [2.0] * 4


def test_the_environments_options_are_not_the_presets(trained: Path, tmp_path: Path) -> None:
    config = json.loads((trained / "config.json").read_text())
    config["env"]["flicker"] = 0.5
    (tmp_path / "config.json").write_text(json.dumps(config))
    assert ReportRun.read(tmp_path).changed()["env.flicker"] == [0.0, 0.5]


def test_a_run_that_trains_and_was_never_evaluated(trained: Path, tmp_path: Path) -> None:
    path = tmp_path / "begun"
    shutil.copytree(trained, path, ignore=shutil.ignore_patterns("result.json", "checkpoints", "replay"))
    lines = (path / "metrics.jsonl").read_text().splitlines()
    kept = [line for line in lines if json.loads(line)["role"] != "evaluator"]
    (path / "metrics.jsonl").write_text("\n".join(kept[: len(kept) // 2]) + '\n{"role": "lear')
    (path / "checkpoints").mkdir()
    folder = RunFolder(path)
    folder.lock.take()
    try:
        text = written(tmp_path / "report.html", str(path))
    finally:
        folder.lock.release()
    assert "<td>training</td>" in text
    assert "Without an evaluation yet: begun." in text
    assert "No video: " in text
    assert "No world-model rollouts: " in text
    assert 'alt="shares of time that the roles of begun worked and waited"' in text
    assert "<td>stopped</td>" in written(tmp_path / "report.html", str(path), "--no-video")


def test_what_a_run_began_with_and_what_changed_is_said(trained: Path, tmp_path: Path) -> None:
    path = tmp_path / "warm"
    shutil.copytree(trained, path)
    start = json.loads((path / "history.jsonl").read_text().splitlines()[0])
    start["init_from"] = {"asked": ["source", "all"], "run": "/old/source", "checkpoint": 7, "parts": "all"}
    again = start | {"init_from": None, "env_steps": 1500, "changes": {"total_steps": [1500, 2000]}}
    (path / "history.jsonl").write_text(f"{json.dumps(start)}\n{json.dumps(again)}\n")
    text = written(tmp_path / "report.html", str(path), "--no-video")
    note = "2 starts; began with all of /old/source, update 7; from step 1,500 --total-steps 1500 to 2000"
    assert f'<p class="note">{note}</p>' in text


def test_of_a_run_without_a_record_there_is_still_a_page(trained: Path, tmp_path: Path) -> None:
    path = tmp_path / "<b>new & empty"
    path.mkdir()
    shutil.copy(trained / "config.json", path)
    text = written(tmp_path / "report.html", str(path), "--no-video")
    assert "Nothing is recorded yet." in text
    assert "<b>new" not in text
    assert "The newest policy" not in text


def test_where_nothing_renders_the_video_is_a_note(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    text = written(tmp_path / "report.html", str(trained))
    assert "No video: nothing here can render" in text
    assert "<video" not in text
    assert "data:image/png" in text  # the world model's picture needs no renderer


def test_film_and_rollouts_are_of_one_checkpoint(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though the run goes on meanwhile; if it goes too far, of the newest there is."""
    path, read, load, saves = tmp_path / "run", list[int](), CheckpointFolder.load, 1
    shutil.copytree(trained, path)

    def newer(checkpoints: CheckpointFolder, number: int) -> dict[str, bytes]:
        read.append(number)
        files = load(checkpoints, number)
        for _ in range(saves):
            checkpoints.save(checkpoints.numbers()[-1] + 1, files)
        return files

    monkeypatch.setattr(CheckpointFolder, "load", newer)
    monkeypatch.setattr(video, "prepare", lambda *_: None)
    monkeypatch.setattr(video, "record", lambda policy, env, seed, out, longest: out.write_bytes(b"film"))
    text = written(tmp_path / "report.html", str(path))
    assert "data:image/png" in text
    assert "data:video/mp4" in text
    assert (len(read), len(set(read))) == (2, 1)  # the world model's and the film's
    saves = 4
    assert "data:video/mp4" in written(tmp_path / "report.html", str(path))


def test_a_folder_whose_name_is_no_text_is_reported(trained: Path, tmp_path: Path) -> None:
    odd = tmp_path / os.fsdecode(b"run-\xff")
    shutil.copytree(trained, odd)
    assert "run-?" in written(tmp_path / "report.html", "--no-video", str(odd))


def test_a_baseline_stands_beside_a_run(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baseline_settings, "PAPER_NET", [16, 16])
    path = tmp_path / "sac"
    words = ["baseline", "sac", "InvertedPendulum-v5", "--total-steps", "200", "--checkpoint-steps", "100"]
    assert run([*words, "--episodes", "1", "--run-dir", str(path)]) == 0
    text = written(tmp_path / "report.html", str(trained), str(path))
    assert "SAC 400-300</span>" in text
    assert "Of a baseline there is no video." in text
    assert "A baseline has no world model." in text
    assert "A baseline records neither waits nor rates." in text
    alone = written(tmp_path / "report.html", str(path))
    assert "<td>finished</td>" in alone
    assert "A baseline has no preset." in alone
    assert "<code>--total-steps</code>" in alone


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "RUNS='': give folders of runs"),
        (["nowhere"], "is not there; give the folder of a run"),
        (["nowhere", "elsewhere"], "none of them is a run's folder"),
        (["nowhere", "--out", "no/report.html"], "--out='no/report.html': its folder is not there"),
        (["nowhere", "--out", "report.pdf"], "give a name that ends in .html or .htm"),
    ],
)
def test_what_it_cannot_do_is_one_line(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["report", *words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_a_folder_of_runs_means_all_of_them(trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path / "runs" / "seed-0")
    assert "Report of seed-0" in written(tmp_path / "report.html", str(tmp_path / "runs"), "--no-video")


def test_a_folder_that_is_no_run_is_left_out(trained: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    text = written(tmp_path / "report.html", str(trained), str(tmp_path / "nowhere"), "--no-video")
    assert "Report of seed-0" in text
    assert "(left out)" in caplog.text


@pytest.mark.parametrize("package", ["matplotlib", "jinja2"])
def test_what_is_not_installed_is_named(
    package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    hide(package, monkeypatch)
    assert run(["report", "nowhere", "--out", str(tmp_path / "report.html")]) == 2
    err = capsys.readouterr().err
    assert f"{package} is missing; pip install" in err
    assert "[report]" in err


def test_differences_are_those_that_matter() -> None:
    class Run:
        def __init__(self, name: str, **options: Any) -> None:
            self.name, self.options = name, options

    table = report.differences(
        [Run("a", seed=0, gamma=0.9, heads=[4, 2]), Run("b", seed=1, gamma=0.9), Run("c", seed=1)]
    )  # type: ignore[list-item]
    assert table["columns"] == ["a", "b", "c"]
    assert table["rows"] == [["--seed", "0", "1", "1"]]
    ours, baselines = (
        Run("a", **{"learner.checkpoint_steps": 1_000}),
        Run("b", **{"checkpoint_steps": 100, "env.id": "X"}),
    )
    beside = report.differences([ours, baselines, Run("c", **{"env.id": "Y"})])  # type: ignore[list-item]
    assert beside["rows"] == [["--checkpoint-steps", "1 000", "100", "-"], ["ENV", "-", "X", "Y"]]
    alike = report.differences([Run("a", seed=0), Run("b", seed=0)])  # type: ignore[list-item]
    assert (alike["rows"], alike["note"]) == ([], "All options are alike.")
