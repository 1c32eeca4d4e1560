"""The command line: its flags, and that every error is one line and exit status 2 before anything starts."""

import errno
import json
import math
import os
import re
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

import psutil
import pytest
from docstring_parser import parse_from_object

from rmc.cli import main, parser, train_options
from rmc.cli.training import open_folder
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.monitor.output import Output
from rmc.deploy.redis.connect import PATIENCE_VARIABLE
from rmc.deploy.run.config import to_json
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import open_run
from rmc.deploy.run.presets import debug, paper
from tests.command import complaint, rmc
from tests.runs import untrained

PENDULUM = "InvertedPendulum-v5"
DEBUG = ["train", PENDULUM, "--preset", "debug"]

# Whoever changes this list changes what users have in their scripts.
TRAIN_FLAGS = """
    --init-from --init-parts
    --preset --seed --total-steps --actors --flicker --drop-sensors --flicker-burst --delay --hide --noise
    --frame-stack --action-repeat --time-limit --env-timeout --env-kwargs
    --config --run-dir --if-exists --launcher --device --redis-url --ray-address --all-cpus --tls
    --track --track-project --track-tags --video-every --metrics-port --metrics-host --dry-run
    --burn-in --trained-steps
    --hidden --embedding --heads --gate-init --head-input --critic-batch-norm --privileged-critic
    --normalize-observations --grounding
    --missing-flag --impute-missing --initial-priority
    --envs-per-actor --reward-scale --stride --refresh-steps --chunk-windows --chunk-seconds --unacked-bytes
    --capacity --replay-shards --replay-ratio --warmup-steps --priority-exponent --importance-exponent
    --learning-rate --memory-learning-scale
    --alpha-learning-rate --target-entropy --gamma --polyak --clip-norm --policy-ema-updates
    --latent-target --target-memory --policy-q
    --scheme --policy-through-q --update-order --model-norm --policy-delay --n-step --state-strategy
    --curiosity --curiosity-scale --curiosity-steps --eta
    --batch-size --publish-updates --checkpoint-steps --keep-checkpoints --precision --threads
    --episodes --evaluation-seconds
""".split()  # noqa: SIM905
ENV_FLAGS = """
    --flicker --drop-sensors --flicker-burst --delay --hide --noise --frame-stack --action-repeat --time-limit
    --env-timeout --env-kwargs
""".split()  # noqa: SIM905
NEW_RUN_FLAGS = {"--run-dir", "--config", "--if-exists", "--init-from", "--init-parts"}
RESUME_FLAGS = [flag for flag in TRAIN_FLAGS if flag not in NEW_RUN_FLAGS]
OTHER_FLAGS = {
    "sweep": [
        *"--seeds --grid --search --trials --sampler-seed --prune --sweep-dir --jobs --drop-replay --launcher".split(),  # noqa: SIM905
        "--ray-address",
    ],
    "resume": RESUME_FLAGS,
    "evaluate": ["--episodes", "--seconds", "--flicker", "--checkpoint", "--video", "--env-timeout", "--json"],
    "export": ["--out", "--checkpoint"],
    "inspect": ["--out", "--checkpoint"],
    "hub push": ["--checkpoint", "--license", "--private"],
    "hub pull": ["--out", "--revision"],
    "check-env": [*ENV_FLAGS, "--steps"],
    "baseline": [
        *ENV_FLAGS,
        *"--settings --seed --total-steps --checkpoint-steps --episodes --threads --precision --run-dir".split(),  # noqa: SIM905
    ],
    "plot": ["--out", "--by", "--reference"],
    "report": ["--out", "--video"],
    "watch": ["--host", "--port"],
    "doctor": [],
    "stats": ["--json"],
    "list": ["--json", "--ray-address"],
    "attach": [],
    "stop": ["--ray-address"],
    "cluster": [],
    "completion": [],
    "role launcher": ["--ray-address"],
    "role actor": ["--run", "--redis-url", "--index"],
    "role replay": ["--run", "--redis-url", "--folder", "--listen", "--shard", "--secret-file", "--tls-folder"],
    "role learner": ["--run", "--redis-url", "--folder", "--device", "--secret-file", "--tls-folder"],
    "role evaluator": ["--run", "--redis-url"],
}


def flags(command: str, capsys: pytest.CaptureFixture[str]) -> set[str]:
    assert main.run([*command.split(), "--help-all"]) == 0
    options = re.findall(r"--[a-z][a-z-]*[a-z]", capsys.readouterr().out)
    return set(options) - {"--help", "--help-all"}


@pytest.mark.parametrize(("command", "expected"), [("train", TRAIN_FLAGS), *OTHER_FLAGS.items()])
def test_the_flags_are_these(command: str, expected: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    options = flags(command, capsys)
    assert {flag for flag in options if not flag.startswith("--no-")} == set(expected)


def classes(kind: type) -> Iterator[type]:
    """A command's dataclass, those that it inherits from, and those of its parts and subcommands."""
    yield from filter(is_dataclass, kind.__mro__)
    for hint in get_type_hints(kind).values():
        yield from (one for part in (hint, *get_args(hint)) if is_dataclass(part) for one in classes(part))


@pytest.mark.parametrize("command", parser.COMMANDS)
def test_a_help_text_breaks_at_no_line_of_its_source(command: str) -> None:
    for kind in classes(parser.COMMANDS[command][0]):
        texts = {text.arg_name: text.description or "" for text in parse_from_object(kind).params}
        assert [name for name, text in texts.items() if "\n" in text] == [], kind


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            "train X --learning-rat 5",
            "Unrecognized options: --learning-rat, 5; did you mean --learning-rate? (see rmc train --help-all)",
        ),
        (
            "train X --actors 2 --no-grunding",
            "Unrecognized options: --no-grunding; did you mean --grounding? (see rmc train --help-all)",
        ),
        (
            "evaluate x --episods 3",
            "Unrecognized options: --episods, 3; did you mean --episodes? (see rmc evaluate --help)",
        ),
        ("train X --zzzz", "Unrecognized options: --zzzz (see rmc train --help-all)"),
        *(
            (
                f"train X {option}",
                "Unrecognized options: False; write --grounding or --no-grounding, without a value "
                "(see rmc train --help-all)",
            )
            for option in ("--grounding=False", "--no-grounding False")
        ),
        ("train X --lr 3", "Unrecognized options: --lr, 3 (see rmc train --help-all)"),
        ("train X --cuda", "Unrecognized options: --cuda (see rmc train --help-all)"),
        ("trian X", "Unrecognized options: trian, X; did you mean train? (see rmc --help)"),
        (
            "resume x --if-exists new",
            "Unrecognized or misplaced options: --if-exists new; --if-exists is an option of rmc train "
            "(see rmc resume --help-all)",
        ),
        (
            "train --config /dev/null --seed x",
            "Error parsing --seed: 'x' is no whole number (see rmc train --help-all)",
        ),
        (
            "train X --run runs/first",
            "Unrecognized or misplaced options: --run runs/first; did you mean --run-dir? (see rmc train --help-all)",
        ),
        (
            "resume x --config f.toml",
            "Unrecognized or misplaced options: --config f.toml; --config is an option of rmc train "
            "(see rmc resume --help-all)",
        ),
        (
            "hub push x me/y --checkpoint best --licence mit",
            "Unrecognized options: --licence, mit; did you mean --license? (see rmc hub --help)",
        ),
    ],
)
def test_a_wrong_option_is_one_short_line(words: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert complaint(words.split(), capsys) == f"rmc: {said}"


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["train", "Nope-v0"], "Nope-v0"),
        ([*DEBUG, "--redis-url", "unix:///nowhere/redis.sock"], "--redis-url"),
        ([*DEBUG, "--redis-url", "redis://user:hush@localhost:1"], "redis://localhost:1"),
        ([*DEBUG, "--redis-url", "redis://localhost:1?password=hush"], "redis://localhost:1"),
        ([*DEBUG, "--redis-url", "redis://:hush#x@localhost:1"], "--redis-url='redis://…'"),
        ([*DEBUG, "--launcher", "lockstep", "--redis-url", "redis://:hu/sh@localhost:1"], "--redis-url='redis://…'"),
        ([*DEBUG, f"--redis-ulr=redis://:{80 * 'x'}hush@localhost:1"], "--redis-ulr=redis://localhost:1"),
        ([*DEBUG, "--actors", "redis://:hush@localhost:1"], "redis://localhost:1"),
        ([*DEBUG, "--redis-url", "localhost"], "--redis-url"),
        ([*DEBUG, "--gamma", "nan"], "--gamma"),
        ([*DEBUG, "--actors", "0"], "--actors"),
        ([*DEBUG, "--envs-per-actor", "0"], "--envs-per-actor"),
        ([*DEBUG, "--batch-size", "1.5"], "--batch-size"),
        ([*DEBUG, "--capacity", "1000000000000"], "--capacity"),
        ([*DEBUG, "--device", "tpu"], "--device"),
        ([*DEBUG, "--preset", "best"], "--preset"),
        ([*DEBUG, "--track", "neptune"], "--track"),
        ([*DEBUG, "--track-project", "mine"], "--track-project='mine': say which tracker"),
        ([*DEBUG, "--dry-run", "--init-from", "nowhere"], "--init-from='nowhere': no such run"),
        ([*DEBUG, "--dry-run", "--metrics-port", "99999"], "--metrics-port=99999: take a port"),
        ([*DEBUG, "--dry-run", "--track-project", "mine"], "--track-project='mine': say which tracker"),
        ([*DEBUG, "--run-dir", "x" * 300], "File name too long; give another"),
        (["stats", "x" * 300], "File name too long"),
        (["check-env", PENDULUM, "--env-timeout", "0"], "--env-timeout=0.0: take a number from 0.1"),
        ([*DEBUG, "--track", "wandb", "--track-project", "a/b"], "--track-project='a/b'"),
        ([*DEBUG, "--track", "trackio", "--track-tags", "x" * 65], "--track-tags"),
        ([*DEBUG, "--metrics-port", "0"], "--metrics-port=0: take a port from 1 to 65535"),
        ([*DEBUG, "--metrics-port", "9", "--metrics-host", "203.0.113.1"], "--metrics-host='203.0.113.1': is no"),
        ([], "train"),
        (["train"], "train"),
        (["train", "--run-dir", "nowhere"], "or --run-dir with a run; nowhere holds none"),
        (["resume"], "RUN"),
        (["resume", "nowhere"], "nowhere': is not there"),
        ([*DEBUG, "--init-from", "nowhere"], "--init-from='nowhere': no such run"),
        ([*DEBUG, "--init-parts", "policy"], "--init-parts='policy': say whose"),
        (["stats", "/nowhere"], "/nowhere"),
        (["list"], "FOLDER='runs'"),
        (["list", "/nowhere"], "/nowhere"),
        (["evaluate", "/nowhere"], "/nowhere"),
        (["role", "actor", "--run", "x", "--redis-url", "unix:///nowhere/redis.sock"], "--redis-url"),
        (["role", "actor"], "--run"),
    ],
)
def test_errors_are_one_line(
    words: list[str], named: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(PATIENCE_VARIABLE, "1")
    monkeypatch.setattr(Output, "log", None)  # of a run that another test began
    line = complaint(words, capsys)
    assert named in line
    assert "hush" not in line
    assert not list(tmp_path.iterdir())  # nothing was started or written


@pytest.mark.parametrize("words", [DEBUG, ["role", "actor", "--run", "x"]])
@pytest.mark.parametrize("login", ["", ":hush@"])
def test_a_password_on_the_command_line_is_warned_of_once(words: list[str], login: str) -> None:
    done = rmc(*words, "--redis-url", f"redis://{login}localhost:1", env=os.environ | {"RMC_PATIENCE": "0"})
    *warnings, error = done.stderr.splitlines()
    assert error.startswith("rmc: --redis-url='redis://localhost:1': no Redis answers there")
    assert ["file:PATH" in line for line in warnings] == [True] * bool(login)
    assert "hush" not in done.stderr + done.stdout


def test_a_password_in_a_file_of_options_is_not_warned_of(tmp_path: Path) -> None:
    """No process list shows it."""
    (tmp_path / "run.toml").write_text('redis_url = "redis://:hush@localhost:1"')
    done = rmc(*DEBUG, "--config", str(tmp_path / "run.toml"), env=os.environ | {"RMC_PATIENCE": "0"})
    assert done.stderr.splitlines()[0].startswith("rmc: --redis-url='redis://localhost:1': no Redis answers there")


def test_a_redis_beside_ray_is_refused_without_its_password() -> None:
    """Where the check is made: to get there from the command line takes a cluster."""
    placement = LaunchOptions(None, "fail", launcher="ray", redis_url="redis://user:hush@localhost:1")
    with pytest.raises(ConfigError, match="--redis-url='redis://localhost:1': a run on Ray"):
        open_folder(debug(EnvConfig(PENDULUM)), placement)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"launcher": "ray", "device": "cuda:1"}, "--device='cuda:1': take cpu or cuda; Ray says which GPU"),
        ({"ray_address": "head:6379"}, "--ray-address='head:6379': give --launcher ray, or leave it"),
        (
            {"launcher": "lockstep", "redis_url": "redis://user:hush@localhost:1"},
            "--redis-url='redis://localhost:1': a lockstep run has no use for one",
        ),
    ],
)
def test_what_a_launcher_has_no_use_for_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        open_folder(debug(EnvConfig(PENDULUM)), LaunchOptions(None, "fail", **options))


def test_a_full_disk_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def full(words: list[str]) -> int:
        with open("/dev/full", "wb", buffering=0) as file:
            return file.write(b"x")

    monkeypatch.setattr(main, "_parse_and_run", full)
    assert main.run(["train"]) == 1
    assert capsys.readouterr().err == "rmc: disk: No space left on device; make room and try again\n"


def test_a_path_of_somebody_else_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refused(path: Path, *_: Any, **__: Any) -> Any:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Output, "log", None)  # of a run that another test began
    monkeypatch.setattr(Path, "exists", refused)  # root may look everywhere
    words = [*DEBUG, "--run-dir", str(tmp_path / "theirs")]
    assert f"{tmp_path / 'theirs' / 'config.json'}: Permission denied; give another" in complaint(words, capsys)
    monkeypatch.undo()
    monkeypatch.setattr(Output, "log", None)
    monkeypatch.setattr(Path, "read_bytes", refused)
    (tmp_path / "config.json").write_text("{}")
    assert f"RUN='{tmp_path}': config.json cannot be read (Permission denied)" in complaint(
        ["stats", str(tmp_path)], capsys
    )


def test_a_file_in_place_of_a_run_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert "is there and is no run's folder" in complaint([*DEBUG, "--run-dir", str(tmp_path / "file")], capsys)
    assert "file/run" in complaint([*DEBUG, "--run-dir", str(tmp_path / "file" / "run")], capsys)


@pytest.mark.parametrize("words", [DEBUG, ["stats", "run"], ["--help"]])
def test_a_working_folder_that_is_gone_is_one_line(words: list[str], tmp_path: Path) -> None:
    gone = f"mkdir gone && cd gone && rmdir ../gone && exec {sys.executable} -m rmc.cli.main {' '.join(words)}"
    done = subprocess.run(["sh", "-c", gone], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (2, "rmc: the working folder is gone; cd to one that is there\n")


def test_without_a_temporary_folder_nothing_starts(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: ["/nowhere"])
    assert "rmc: TMPDIR=" in complaint([*DEBUG, "--run-dir", str(tmp_path / "run")], capsys)
    assert not (tmp_path / "run").exists()


def opened_run(folder: Path) -> RunFolder:
    return untrained(folder, debug(EnvConfig(PENDULUM)))


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["train", "InvertedDoublePendulum-v5", "--preset", "debug"], "ENV='InvertedDoublePendulum-v5'"),
        ([*DEBUG, "--if-exists", "fail"], "--if-exists"),
    ],
)
def test_another_runs_folder_is_refused(
    words: list[str], named: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    opened_run(tmp_path / "run")
    assert named in complaint([*words, "--run-dir", str(tmp_path / "run")], capsys)


def test_a_folder_that_is_no_runs_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").touch()
    assert "no run's folder" in complaint([*DEBUG, "--run-dir", str(tmp_path)], capsys)


def test_a_folder_in_use_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    run = open_run(debug(EnvConfig(PENDULUM)), LaunchOptions(tmp_path / "run", "fail"))
    assert "stop it first" in complaint([*DEBUG, "--run-dir", str(tmp_path / "run")], capsys)
    run.lock.release()


def test_a_corrupt_checkpoint_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    run = opened_run(tmp_path / "run")
    checkpoint = run.checkpoints / "000000010"
    checkpoint.mkdir()
    (checkpoint / "manifest.json").write_text('{"update": 10, "sha256": {"policy.safetensors": "00"}}')
    (checkpoint / "policy.safetensors").write_bytes(b"rot")
    for words in ([*DEBUG, "--run-dir", str(run.path)], ["evaluate", str(run.path)]):
        assert "policy.safetensors does not match" in complaint(words, capsys)
    assert "latest, best or one of [10]" in complaint(["evaluate", str(run.path), "--checkpoint", "11"], capsys)
    assert "none was evaluated whole" in complaint(["evaluate", str(run.path), "--checkpoint", "best"], capsys)


def test_runs_without_checkpoint_or_metrics_say_so(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    run = opened_run(tmp_path / "run")
    assert "no checkpoint yet" in complaint(["evaluate", str(run.path)], capsys)
    assert main.run(["stats", str(run.path)]) == 0
    assert "InvertedPendulum-v5" in capsys.readouterr().out
    assert "--episodes=0" in complaint(["evaluate", str(run.path), "--episodes", "0"], capsys)
    assert "--flicker=2.0" in complaint(["evaluate", str(run.path), "--flicker", "2"], capsys)


def test_stats_and_list_as_json(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    run = opened_run(tmp_path / "runs" / "run")
    records = [
        {"role": "replay", "time": 1.0, "env_steps": 700, "replay_ratio": math.inf},
        {"role": "launcher", "time": 1.0, "wall_s": 9.0},
        {"role": "evaluator", "eval_return_mean": 4.5, "eval_return_std": 0.5, "eval_update": 5, "eval_env_steps": 600},
    ]
    run.metrics.write_text("".join(json.dumps(record) + "\n" for record in records))
    assert main.run(["stats", str(run.path), "--json"]) == 0
    value = json.loads(capsys.readouterr().out)
    assert (value["state"], value["env"], value["env_steps"], value["elapsed_s"]) == ("stopped", PENDULUM, 700, 9.0)
    evaluation = {"return_mean": 4.5, "return_std": 0.5, "update": 5, "env_steps": 600, "is_complete": True}
    assert value["last_evaluation"] == value["best_evaluation"] == evaluation
    assert value["roles"]["replay"] == records[0] | {"replay_ratio": None}  # which JSON cannot say
    assert (value["eta_s"], value["result"]) == (None, None)
    assert main.run(["list", str(tmp_path / "runs"), "--json"]) == 0
    (listed,) = json.loads(capsys.readouterr().out)
    assert (listed["run"], listed["state"], listed["eval_return"]) == (str(run.path), "stopped", 4.5)


def test_a_damaged_run_is_listed_and_told(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    opened_run(tmp_path / "sound")
    (opened_run(tmp_path / "torn").path / "config.json").write_text("{")
    assert main.run(["list", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert re.search(r"^sound +new ", output, re.MULTILINE)
    assert re.search(r"^torn +damaged ", output, re.MULTILINE)
    assert f"config.json='{tmp_path / 'torn' / 'config.json'}': not JSON" in output


def test_a_role_needs_its_runs_secret(
    redis_url: str, run_name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RMC_PATIENCE", "0.2")
    words = ["role", "replay", "--run", run_name, "--redis-url", redis_url, "--folder", str(tmp_path / "replay")]
    assert "RMC_SECRET" in complaint(words, capsys)
    assert "cannot be read" in complaint([*words, "--secret-file", str(tmp_path / "none")], capsys)
    secret = tmp_path / "secret"
    secret.write_text("x\n")
    assert "no run of this name" in complaint([*words, "--secret-file", str(secret)], capsys)


def test_new_takes_a_folder_beside(tmp_path: Path) -> None:
    config = debug(EnvConfig(PENDULUM))
    opened_run(tmp_path / "run")
    beside = open_run(config, LaunchOptions(tmp_path / "run", "new"))
    beside.lock.release()
    assert beside.path == tmp_path / "run-2"


def test_a_runs_folder_is_its_owners_alone_until_they_open_it(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir(mode=0o755)
    run = opened_run(tmp_path / "run")
    assert [stat.S_IMODE(path.stat().st_mode) for path in (run.path, run.secret_file)] == [0o700, 0o600]
    run.path.chmod(0o750)
    untrained(run.path, run.config())
    assert stat.S_IMODE(run.path.stat().st_mode) == 0o750


FAILS = """
import subprocess
from rmc.cli import main
def fail(words):
    main.descendants.adopt_orphans()
    print(subprocess.Popen(["sleep", "60"], start_new_session=True, stdout=subprocess.DEVNULL).pid, flush=True)
    raise RuntimeError("unforeseen")
main.run = fail
main.main()
"""


def test_what_an_environment_started_ends_with_a_command_that_fails_of_a_bug() -> None:
    ended = subprocess.run([sys.executable, "-c", FAILS], capture_output=True, text=True, check=False)
    assert (ended.returncode, "RuntimeError: unforeseen" in ended.stderr) == (1, True)
    assert not psutil.pid_exists(int(ended.stdout))


def test_what_a_shell_started_before_it_became_a_command_lives_on() -> None:
    """Bash runs the last command of ``-c`` in its own place."""
    words = f"sleep 60 >&- 2>&- & echo $!; exec {sys.executable} -m rmc.cli.main --version"
    ended = subprocess.run(["bash", "-c", words], capture_output=True, text=True, check=True)
    child = psutil.Process(int(ended.stdout.split()[0]))
    assert child.name() == "sleep"
    child.kill()
    child.wait(10)


def test_options_become_the_config() -> None:
    words = ["train", PENDULUM, "--preset", "paper", "--seed", "4", "--envs-per-actor", "3", "--heads", "64", "32"]
    command = parser.parse([*words, "--replay-ratio", "64", "--flicker", "0.5", "--head-input", "hidden+observation"])
    assert isinstance(command, train_options.Train)
    config = command.config()
    expected = paper(EnvConfig(PENDULUM, 0.5))
    assert (config.seed, config.actor.envs_per_actor, config.agent.heads) == (4, 3, (64, 32))
    assert (config.replay.replay_ratio, config.agent.head_input, config.env.flicker) == (
        64.0,
        "hidden+observation",
        0.5,
    )
    assert config.update == expected.update
    assert to_json(config) != to_json(expected)
