"""What rmc resume, and rmc train on a run's folder, take from the run and from the words."""

import dataclasses
import logging
from pathlib import Path
from typing import get_args

import pytest

from rmc.analysis.baseline_settings import BaselineConfig
from rmc.cli import main, parser, run_options, train_options
from rmc.common.env.config import EnvConfig
from rmc.deploy.run.config import Preset, RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import open_run
from rmc.deploy.run.option_names import flat
from rmc.deploy.run.preflight import check_port
from rmc.deploy.run.presets import debug, preset_config
from tests.command import complaint

PENDULUM = "InvertedPendulum-v5"


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    """One that has no option as its preset, nor as another."""
    config = debug(EnvConfig(PENDULUM, flicker=0.25, env_kwargs={"reset_noise_scale": 0.02}))
    config = dataclasses.replace(
        config, seed=3, total_steps=12_345, agent=dataclasses.replace(config.agent, heads=(7, 5), missing_flag=True),
        update=dataclasses.replace(config.update, learning_rate=0.1 + 0.2),
    )  # fmt: skip
    folder = open_run(config, LaunchOptions(tmp_path / "run", "fail", launcher="lockstep", device="cuda"))
    folder.lock.release()
    return folder


def parsed(*words: object) -> tuple[RunConfig, LaunchOptions]:
    command = parser.parse([str(word) for word in words])
    assert isinstance(command, train_options.Train)
    return command.config(), command.launch_options()


def test_what_is_not_said_is_as_it_was(run: RunFolder) -> None:
    options = LaunchOptions(run.path, launcher="lockstep", device="cuda")
    for words in (["resume"], ["train", "--run-dir"], ["train", PENDULUM, "--preset", "debug", "--run-dir"]):
        config, launch = parsed(*words, run.path)
        assert config == run.config()
        assert launch == options


@pytest.mark.parametrize("name", get_args(Preset))
def test_every_preset_gives_its_defaults(name: Preset) -> None:
    expected = preset_config(name, EnvConfig(PENDULUM))
    assert (
        parsed("train", PENDULUM, "--preset", name)[0] == parsed("train", PENDULUM, f"--preset={name}")[0] == expected
    )


def test_of_two_presets_the_last_gives_its_defaults() -> None:
    expected = preset_config("debug", EnvConfig(PENDULUM))
    for given in (("--preset=paper", "--preset", "debug"), ("--preset", "paper", "--preset=debug")):
        assert parsed("train", PENDULUM, *given)[0] == expected


def test_what_is_said_is_all_that_changes(run: RunFolder) -> None:
    words = ("--total-steps", 20_000, "--replay-ratio", "7.5", "--launcher", "local", "--no-missing-flag")
    for command in (
        ("resume", run.path, *words),
        ("resume", *words, run.path),
        ("train", *words, "--run-dir", run.path),
    ):
        config, launch = parsed(*command)
        was, now = flat(run.config()), flat(config)
        assert {path: now[path] for path in now if now[path] != was[path]} == {
            "total_steps": 20_000, "replay.replay_ratio": 7.5, "agent.missing_flag": False
        }  # fmt: skip
        assert (launch.launcher, launch.device) == ("local", "cuda")


def test_another_launcher_takes_the_device_alone_along(tmp_path: Path) -> None:
    path, config = tmp_path / "run", debug(EnvConfig(PENDULUM))
    last = LaunchOptions(
        path, launcher="ray", device="cuda", ray_address="local", all_cpus=True, tls=True, metrics_port=9464
    )
    open_run(config, last).lock.release()
    assert parsed("resume", path)[1] == last
    assert parsed("resume", path, "--launcher", "local")[1] == LaunchOptions(path, device="cuda")
    assert parsed("resume", path, "--launcher", "ray", "--no-tls")[1] == dataclasses.replace(last, tls=False)
    assert parsed("resume", path, "--metrics-port", "None")[1] == dataclasses.replace(last, metrics_port=None)


def test_a_run_that_was_served_goes_on_without(run: RunFolder) -> None:
    last = LaunchOptions(run.path, metrics_port=9464, metrics_host="0.0.0.0")
    open_run(run.config(), last).lock.release()
    launch = parsed("resume", run.path, "--metrics-port", "None")[1]
    assert launch.metrics_port is None
    check_port(launch)


def test_a_new_folder_beside_it_begins_with_the_preset(run: RunFolder) -> None:
    config, launch = parsed("train", PENDULUM, "--preset", "debug", "--run-dir", run.path, "--if-exists", "new")
    assert config == debug(EnvConfig(PENDULUM))
    assert launch == LaunchOptions(run.path, "new")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--capacity", "30"], "--capacity=30: the run in {} has 2000, and its ring was made so; use that"),
        (["--seed", "4"], "--seed=4: the run in {} has 3, and its random numbers began with that"),
        (
            ["--scheme", "2"],
            "--scheme=2: the run in {} has 1, and its networks and optimisers belong to that algorithm",
        ),
        (["--preset", "paper"], "--preset='paper': the run in {} has 'debug', and its other options came from that"),
        (["--flicker", "0"], "--flicker=0.0: the run in {} has 0.25, and its experience is from that environment"),
        (["--total-steps", "400"], "--total-steps=400: take more than --warmup-steps=500, which a new run may"),
        (["--device", "tpu"], "--device='tpu'"),
    ],
)
def test_what_may_not_change_is_one_line(
    words: list[str], message: str, run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    before = run.history_file.read_bytes()
    line = complaint(["resume", str(run.path), "--device", "cpu", *words], capsys)
    assert message.format(run.path) in line
    assert run.history_file.read_bytes() == before


@pytest.mark.parametrize("command", [["resume"], ["train", "--run-dir"]])
def test_help_shows_the_runs_own_defaults(
    command: list[str], run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    for flag in ("--help", "--help-all"):
        assert main.run([*command, str(run.path), flag]) == 0
        shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert "(default: 12345)" in shown  # --total-steps
        assert "(default: 0.30000000000000004)" in shown  # --learning-rate
    assert "(default: cuda)" in shown


def test_help_of_no_run_is_the_presets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["resume"], ["resume", str(tmp_path)], ["train", "--run-dir", str(tmp_path)], ["train"]):
        assert main.run([*words, "--help"]) == 0
        assert "(default: 1000000)" in " ".join(capsys.readouterr().out.split())


def begun(config: BaselineConfig, path: Path) -> RunFolder:
    """A baseline's run that has trained nothing."""
    from rmc.analysis import baselines

    sizes = baselines.layout_sizes(baselines.env_layout(config.env))
    folder, changed = baselines._open_folder(config, path, sizes)
    baselines._write_start(config, folder, sizes, changed)
    folder.lock.release()
    return folder


def test_a_baseline_takes_its_own_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = BaselineConfig("td3", EnvConfig(PENDULUM, flicker=0.5), "default", 2, 700, 300, 4)
    folder = begun(config, tmp_path / "run")
    for words, expected in (([], config), (["--total-steps", "900"], dataclasses.replace(config, total_steps=900))):
        command = parser.parse(["resume", str(folder.path), *words])
        assert isinstance(command, run_options.ResumeBaseline)
        assert (command.config(), command.run_dir) == (expected, folder.path)
    assert "--flicker=0.1: the run in" in complaint(["resume", str(folder.path), "--flicker", "0.1"], capsys)
    assert "--gamma" in complaint(["resume", str(folder.path), "--gamma", "0.9"], capsys)
    assert main.run(["resume", str(folder.path), "--help"]) == 0
    assert "(default: 700)" in " ".join(capsys.readouterr().out.split())
    said = complaint(["train", "--run-dir", str(folder.path)], capsys)
    assert "only rmc evaluate, plot, report, stats, watch, resume and stop take it" in said


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (["--fill-blanks"], ["--impute-missing"]),
        (["--no-fill-blanks"], ["--no-impute-missing"]),
        (["--blank_flag"], ["--missing-flag"]),
        (["--policy-average", "7"], ["--policy-ema-updates", "7"]),
        (["--policy-average=7"], ["--policy-ema-updates=7"]),
    ],
)
def test_an_old_name_is_understood_with_one_warning(
    old: list[str], new: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        words = parser.renamed(["train", PENDULUM, *old])
    assert words == ["train", PENDULUM, *new]
    flags = [word.partition("=")[0] for word in (old[0], new[0])]
    assert caplog.messages == [f"{flags[0]} is called {flags[1]} now; the old name goes in the next version"]
    assert parsed(*words)[0] != parsed("train", PENDULUM)[0] or new == ["--impute-missing"]  # which robust has anyway


def test_the_warning_reaches_the_terminal(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["train", PENDULUM, "--run-dir", str(tmp_path / "run"), "--policy-average", "-1"]
    assert main.run(words) == 2
    assert "--policy-ema-updates=-1: take a number from 0" in capsys.readouterr().err


def test_a_baseline_that_is_named_again_is_as_it_was(tmp_path: Path) -> None:
    config = BaselineConfig("sac", EnvConfig(PENDULUM, flicker=0.5), total_steps=2_000, episodes=20, threads=4)
    folder = begun(config, tmp_path / "run")
    command = parser.parse(["baseline", "sac", PENDULUM, "--threads", "2", "--run-dir", str(folder.path)])
    assert isinstance(command, run_options.Baseline)
    assert command.config() == dataclasses.replace(config, threads=2)
