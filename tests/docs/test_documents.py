"""The README stays true: its commands run, its file tree is the repository's."""

import json
import re
import shlex
import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path

import pytest

from benchmarks import report
from docs import fault_table, generate, results_page
from rmc.cli.parser import COMMANDS, parse
from rmc.cli.sweep_options import Sweep
from rmc.common import agent, critic
from rmc.common.env import missing
from rmc.common.env.config import EnvConfig
from rmc.deploy.run import presets
from rmc.deploy.run.option_names import flat, option
from rmc.learner import diagnostics, losses, update, update_order
from tests.cli.test_main import OTHER_FLAGS, TRAIN_FLAGS
from tests.command import rmc
from tests.docs.running import LOCKSTEP, ran
from tests.runs import untrained

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SHORT = ("--total-steps", "700", *LOCKSTEP)


def test_its_table_names_every_folder() -> None:
    block = README[README.index("## Folders") :].split("\n## ")[0]
    named = set(re.findall(r"^\| `(\w+)/` \|", block, re.MULTILINE))
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    folders = {name.split("/")[0] for name in listed.splitlines() if "/" in name}
    assert named == {name for name in folders if not name.startswith(".")}


def test_it_is_short() -> None:
    assert len(README.splitlines()) <= 130
    assert len((ROOT / "docs" / "results.md").read_text().splitlines()) <= 150


def test_the_faults_that_were_run_are_in_their_page() -> None:
    assert fault_table.PAGE.read_text() == fault_table.page(), "run make docs"
    faults = {row["fault"] for row in json.loads(fault_table.RESULTS.read_text())}
    assert all(f"| {fault} |" in fault_table.page() for fault in faults)
    assert len(faults) >= 10


@pytest.mark.parametrize("path", results_page.HEAD, ids=lambda path: path.name)
def test_the_returns_in_it_are_those_of_the_lines(path: Path) -> None:
    assert results_page.page(path) == path.read_text(), "run make results-page"


def test_every_equation_leads_to_its_code_and_back() -> None:
    """What the docs' table names is there, and its docstring names the equation."""
    modules = {
        "losses": losses, "agent": agent, "critic": critic, "update": update, "update_order": update_order,
        "missing": missing, "diagnostics": diagnostics,
    }  # fmt: skip
    table = (ROOT / "docs" / "algorithm.md").read_text().split("## From the paper to the code")[1].split("\n\n")[1]
    seen = set()
    for row in table.splitlines()[2:]:
        equations, _, code, *_ = (cell for cell in re.split(r"(?<!\\)\|", row)[1:])
        numbers = re.findall(r"\d+", equations) if "eq" in equations else []
        module, docstrings = losses, []
        for name in re.findall(r"`([\w.]+)`", code):
            if "." in name and name.split(".")[0] in modules:
                module, name = modules[name.split(".")[0]], name.split(".")[1]
            if numbers:
                docstrings.append(getattr(module, name).__doc__)
            elif "/" not in name and "." not in name:
                assert hasattr(module, name), name
        assert all(any(f"Eq. {number}:" in text for text in docstrings) for number in numbers), row
        assert all(any(f"Eq. {number}:" in text for number in numbers) for text in docstrings), row
        seen.update(map(int, numbers))
    assert seen == {6, 7, 8, 9, 10, 11, 12}


def test_what_the_table_of_equations_names_is_in_the_sources() -> None:
    """``module.name`` in that file, ``Class.method`` in the class's."""
    table = (ROOT / "docs" / "algorithm.md").read_text().split("## From the paper to the code")[1].split("\n\n")[1]
    cells = [re.split(r"(?<!\\)\|", row)[3] for row in table.splitlines()[2:]]
    named = [name for cell in cells for name in re.findall(r"`([\w./]+)`", cell)]
    folders = ("actors", "common", "learner", "replay_server")
    sources = {path: path.read_text() for folder in folders for path in (ROOT / folder).rglob("*.py")}
    files, names = ([name for name in named if ("/" in name) == kind] for kind in (True, False))
    assert len(files) > 2
    assert len(names) > 20
    assert not [name for name in files if not (ROOT / name).exists()]
    for name in names:
        place, _, last = name.rpartition(".")
        there = [text for path, text in sources.items() if place in ("", path.stem) or f"class {place}" in text]
        assert any(re.search(rf"(def|class) {last}\b|^{last}\b", text, re.M) for text in there), name


def test_the_tests_that_security_names_exist() -> None:
    named = re.findall(r"(?:tests/|\btest_)[\w/]*\.py", (ROOT / "docs/security.md").read_text())
    assert len(named) > 5
    assert not [name for name in named if not (ROOT / name).exists()]


def test_the_measured_figures_are_in_their_page() -> None:
    assert report.table() in report.PAGE.read_text(), "run python -m benchmarks.report"


def test_every_option_of_training_is_in_its_page() -> None:
    page = (ROOT / "docs" / "configuration.md").read_text()
    assert {flag for flag in TRAIN_FLAGS if f"`{flag}`" not in page} == {"--config"}


def test_their_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text()
    rules = re.findall(r"^([a-z%-]+)(?: [a-z%-]+)*:", makefile, re.MULTILINE)
    text = "".join(page.read_text() for page in [*PAGES, ROOT / "CONTRIBUTING.md"])
    targets = set(re.findall(r"`make ([a-z][a-z-]*)|^make ([a-z][a-z-]*)", text, re.MULTILINE))
    named = {first or second for first, second in targets}
    assert {"demo", "test", "env", "test-long"} <= named
    assert [one for one in sorted(named) if not any(fnmatch(one, rule.replace("%", "*")) for rule in rules)] == []


@pytest.mark.timeout(300)
def test_its_commands_run(tmp_path: Path) -> None:
    commands = re.findall(r"```sh\n(rmc .*)\n```", README)
    assert [command.split()[1] for command in commands] == ["train", "evaluate", "stats"]
    for command in commands:
        shorter = ("--total-steps", "1500") if command.startswith("rmc train") else ()
        done = rmc(*command.split()[1:], *shorter, cwd=tmp_path, timeout=280)
        assert done.returncode == 0, done.stdout + done.stderr
        assert done.stderr == ""
        assert not (tmp_path / "MUJOCO_LOG.TXT").exists()
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr


@pytest.mark.timeout(300)
def test_the_python_api_runs(tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python-api.md").read_text(), re.DOTALL)
    assert {name for block in blocks for name in re.findall(r"import (.*)", block)} >= {
        "EnvConfig, presets", "EnvConfig, presets, train", "evaluate", "load_config, train",
        "load_policy",
    }  # fmt: skip
    assert all(len(block.strip().splitlines()) <= 6 for block in blocks)
    code = "\n".join(blocks)
    for printed, shorter in (
        ('train(config, "runs/first"', 'train(config := dataclasses.replace(config, total_steps=700), "runs/first"'),
        ("callback=stop_when_good", "callback=stop_when_good, launcher='lockstep'"),
        ("total_steps=4500,", "total_steps=900, launcher='lockstep',"),
        ('total_steps=5000), "runs/first"', 'total_steps=1000), "runs/first", launcher="lockstep"'),
    ):
        assert code.count(printed) == 1
        code = code.replace(printed, shorter)
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=280)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    assert "'eval_return_mean'" in done.stdout
    assert re.search(r"^[-\d.]+ ± [\d.]+$", done.stdout, re.MULTILINE)


@pytest.mark.timeout(300)
def test_the_environment_of_the_docs_can_be_checked_and_trained_on(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "custom-environments.md").read_text()
    codes = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    for file, code in zip(("shuttle", "scaled", "instruments"), codes, strict=True):
        (tmp_path / f"{file}.py").write_text(code)
    commands = re.findall(r"^rmc .*$", page, re.MULTILINE)
    assert [command.split()[1] for command in commands] == ["check-env", "train", "evaluate", "train"]
    names = []
    for command in commands:
        shorter = ("--preset", "debug", *SHORT) if command.startswith("rmc train") else ()
        names.append(ran(tmp_path, *command.split()[1:], *shorter))
    wrapped = ran(tmp_path, "check-env", "scaled:Scaled-v0")
    assert "time limit 200" in wrapped
    assert wrapped.endswith("it can be trained on\n")
    assert "time limit 100" in names[0]
    assert names[0].endswith("it can be trained on\n")
    assert "note" not in names[0]
    assert "shuttle.mp4: an episode with return" in names[2]
    assert (tmp_path / "shuttle.mp4").stat().st_size > 1000


def test_the_docs_name_options_that_exist() -> None:
    there = {flag for flags in (TRAIN_FLAGS, *OTHER_FLAGS.values()) for flag in flags}
    there |= {
        "--cap-drop", "--exclude", "--find-links", "--generate", "--logdir", "--network", "--no-restart",
        "--node-ip-address", "--read-only", "--rm", "--shm-size", "--user",
    }  # fmt: skip  # of others
    switches = [
        path for path, value in flat(presets.debug(EnvConfig("Pendulum-v1"))).items() if isinstance(value, bool)
    ]
    there |= {option(path).replace("--", "--no-", 1) for path in switches}
    there |= {"--version", "--help", "--help-all"}  # alone
    there |= {"--no-all-cpus", "--no-prune", "--no-video"}  # of where a run is, of a sweep, of a report
    there |= {"--alone", "--first-rate", "--only", "--env", "--play"}  # of benchmarks and studies
    for page in PAGES:
        named = re.findall(r"(?<![\w-])--[a-z][a-z-]*[a-z]", page.read_text())
        assert set(named) - there == set(), page


def test_the_commands_of_all_pages_can_be_parsed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those in blocks, whatever stands before and after them in their line."""
    monkeypatch.chdir(tmp_path)
    for name in ("first", "week"):  # that are resumed
        untrained(Path("runs", name), presets.debug(EnvConfig("InvertedPendulum-v5")))
    text = "".join(page.read_text() for page in PAGES)
    Path("agent.toml").write_text(text.split("```toml\n")[1].split("```")[0])
    blocks = "\n".join(re.findall(r"```\w*\n(.*?)```", text, re.DOTALL)).replace("\\\n", "")
    printed = re.findall(rf"\brmc ((?:{'|'.join(COMMANDS)})\b[^&|;>\n]*)", blocks)
    assert len(printed) > 50
    for line in printed:
        command = parse(shlex.split(line, comments=True))
        if isinstance(command, Sweep):  # whose other options are those of rmc train
            parse(["train", "InvertedPendulum-v5", *command.train_words])


def test_the_page_of_options_is_up_to_date() -> None:
    assert generate.page() == (ROOT / "docs" / "configuration.md").read_text(), "run make docs"
