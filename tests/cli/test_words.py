"""Options from a file, numbers as people write them, the two lengths of help."""

import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import pytest

from rmc.cli import main, parser
from rmc.cli.primitives import read_whole
from rmc.common.errors import ConfigError
from tests.cli.test_main import PENDULUM, flags
from tests.command import complaint

FILE = """
env = "InvertedPendulum-v5"
preset = "debug"
total-steps = 1_200
learning_rate = 1e-3
heads = [24, 16]
missing_flag = true
normalize_observations = false
env_kwargs = { reset_noise_scale = 0.02 }
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "agent.toml").write_text(FILE)
    return tmp_path / "agent.toml"


def test_options_come_from_a_file(file: Path) -> None:
    config = parser.parse(["train", "--config", str(file)]).config()
    assert (config.env.id, config.preset, config.total_steps) == (PENDULUM, "debug", 1_200)
    assert (config.agent.heads, config.agent.missing_flag, config.agent.normalize_observations) == (
        (24, 16),
        True,
        False,
    )
    assert config.update.learning_rate == 1e-3
    assert config.agent.hidden == 32  # the preset's own
    assert config.env.env_kwargs == {"reset_noise_scale": 0.02}


def test_the_command_line_wins_over_the_file(file: Path) -> None:
    given = ["Hopper-v5", "--total-steps", "500", "--preset", "paper", "--env-kwargs", "healthy_reward=2.0"]
    config = parser.parse(["train", *given, f"--config={file}"]).config()
    assert (config.env.id, config.preset, config.total_steps) == ("Hopper-v5", "paper", 500)
    assert config.update.learning_rate == 1e-3
    assert config.env.env_kwargs == {"healthy_reward": 2.0}


def test_a_tilde_is_the_home_where_no_shell_reads_it(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = file.parent
    monkeypatch.setenv("HOME", str(home))
    assert parser.parse(["train", PENDULUM, "--run-dir=~/runs/x"]).run_dir == home / "runs" / "x"
    assert parser.parse(["evaluate", "~/run", "--video=~/a.mp4"]).video == home / "a.mp4"
    assert parser.parse(["plot", "~/runs/*", "x~"]).runs == (home / "runs" / "*", Path("x~"))
    assert parser.parse(["train", PENDULUM, "--run-dir=~nobody-of-that-name/x"]).run_dir == Path(
        "~nobody-of-that-name/x"
    )
    file.write_text(f'run_dir = "~/runs/y"\n{FILE}')
    command = parser.parse(["train", f"--config=~/{file.name}"])
    assert (command.run_dir, command.config_file) == (home / "runs" / "y", file)


@pytest.mark.parametrize(
    ("text", "name", "fix"),
    [
        ("learning_rat = 1.0", "learning_rat=1.0", "did you mean learning_rate"),
        ("zzz = 1.0", "zzz=1.0", "--help-all"),
        ("id = 'Hopper-v5'", "id=", "is no option"),
        ("config = 'other.toml'", "config=", "is no option"),
        ("env = 3", "env=3", "HalfCheetah-v5"),
        ("env_kwargs = 'goal=1'", "env_kwargs=", "table"),
        ("hidden = { a = 1 }", "hidden=", "give a number"),
        ("hidden = [[1]]", "hidden=", "give a number"),
        ("hidden = ", "agent.toml", "not TOML"),
        ("hidden = 'many'", "agent.toml: Error parsing --hidden", "'many' is no whole number"),
        ("heads = ['a']", "agent.toml: Missing value for argument '--heads'", "2 values"),
        ("hidden = -3", "--hidden=-3", "take"),
    ],
)
def test_a_wrong_file_is_refused(
    text: str, name: str, fix: str, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file.write_text(text)
    message = complaint(["train", *([PENDULUM] if "env =" not in text else []), "--config", str(file)], capsys)
    assert name in message
    assert fix in message


@pytest.mark.parametrize("names", [["n-step", "n_step"], ["policy_average", "policy_ema_updates"]])
def test_an_option_that_a_file_names_twice_is_refused(names: list[str], file: Path) -> None:
    file.write_text("".join(f"{name} = {value}\n" for value, name in enumerate(names, 2)))
    with pytest.raises(ConfigError, match=re.escape(f": {names[-1]}={names}: is there twice; leave one")):
        parser.parse(["train", PENDULUM, "--config", str(file)])


def test_a_list_at_the_files_end_takes_no_environment_in(file: Path) -> None:
    file.write_text('env = "Pendulum-v1"\ntrack_tags = ["a", "b"]\n')
    command = parser.parse(["train", "HalfCheetah-v5", "--seed", "2", "--config", str(file)])
    assert (command.env.id, command.track_tags, command.seed) == ("HalfCheetah-v5", ("a", "b"), 2)


def test_a_file_that_is_not_there_or_is_two(tmp_path: Path, file: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml.*cannot be read"):
        parser.parse(["train", PENDULUM, "--config", str(tmp_path / "none.toml")])
    with pytest.raises(ConfigError, match="is there twice"):
        parser.parse(["train", "--config", str(file), f"--config={file}"])
    (tmp_path / "odd").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="is not TOML"):
        parser.parse(["train", "--config", str(tmp_path / "odd")])


ON_A_TERMINAL = """
import os, pty, sys
os.dup2(pty.openpty()[1], 1)
from rmc.cli import main
sys.exit(main.run(sys.argv[1:]))
"""


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["foo"], "Unrecognized options: foo (see rmc --help)"),
        (["sweep", "Pendulum-v1", "--grid", "n_step=1.5"], "grid.n_step=1.5: "),
    ],
)
def test_a_complaint_has_no_colours_on_a_terminal(words: list[str], line: str) -> None:
    done = subprocess.run([sys.executable, "-c", ON_A_TERMINAL, *words], stderr=subprocess.PIPE, text=True, timeout=60)
    assert done.stderr.startswith(f"rmc: {line}")
    assert "\x1b" not in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_no_color_is_for_help_too() -> None:
    terminal, other = pty.openpty()
    words = [sys.executable, "-m", "rmc.cli.main", "completion", "--help"]
    subprocess.run(words, stdout=other, env=os.environ | {"NO_COLOR": "1", "TERM": "xterm"}, timeout=60, check=True)
    shown = os.read(terminal, 65_536).decode()
    assert "usage: rmc completion" in shown
    assert "\x1b" not in shown
    for one in (terminal, other):
        os.close(one)


def test_a_file_is_utf_8_whatever_the_locale(tmp_path: Path) -> None:
    (tmp_path / "options.toml").write_text('env = "Größe-v0"', encoding="utf-8")
    code = "import sys; from pathlib import Path; from rmc.deploy.run.option_names import read_toml; "
    code += "sys.exit(read_toml('--config', Path('options.toml'), '')['env'] != 'Gr\\xf6\\xdfe-v0')"
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=os.environ | plain, timeout=60, check=True)


@pytest.mark.parametrize("word", ["1000000", "1_000_000", "1e6", "1.0E6", "+1000000"])
def test_whole_numbers(word: str) -> None:
    assert read_whole(word) == 1_000_000
    assert parser.parse(["train", PENDULUM, "--total-steps", word]).config().total_steps == 1_000_000


@pytest.mark.parametrize("word", ["1.5", "1e-3", "inf", "nan", "", "a million", "0x10"])
def test_what_is_no_whole_number(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    message = complaint(["train", PENDULUM, f"--total-steps={word}"], capsys)
    assert "--total-steps" in message
    assert "is no whole number" in message


def test_help_is_short_and_help_all_is_whole(capsys: pytest.CaptureFixture[str]) -> None:
    everything = flags("train", capsys)
    assert main.run(["train", "--help"]) == 0
    short = capsys.readouterr().out
    assert "--total-steps" in short
    assert "--help-all" in short
    assert "--priority-exponent" in everything
    assert "--priority-exponent" not in short
    assert len(short.splitlines()) < 100
