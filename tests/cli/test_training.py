"""What rmc train does around the roles."""

import contextlib
import io
import json
import signal
import subprocess
import sys
import time
from dataclasses import replace

import gymnasium as gym
import pytest
from rich.console import Console

from rmc.analysis import evaluation
from rmc.cli import main, training
from rmc.cli.ending import print_end
from rmc.cli.signals import signals_caught, signals_interrupt
from rmc.cli.training import conduct
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import STOPPED_STATUS, RoleDied
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from tests.counting_env import CountingEnv
from tests.runs import AGENTS, make_run

TRAINS_AND_GOES_ON = """
import sys
from rmc.cli import main

words = "train InvertedPendulum-v5 --preset debug --launcher lockstep --warmup-steps 100 --run-dir run --total-steps"
assert [main.run([*words.split(), steps]) for steps in ("150", "200")] == [0, 0]
assert "torch" in sys.modules
assert "torch._dynamo" not in sys.modules
"""


class Endless(CountingEnv):
    """A slow one whose episodes have no end."""

    def step(self, action):
        time.sleep(0.01)
        self._length = self._step + 2
        return super().step(action)


gym.register("NeverEnding-v0", entry_point=Endless)
QUIET = Console(quiet=True)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A run's, whose roles have trained it before they start."""
    monkeypatch.setattr(training, "_launch", lambda *_: True)
    return make_run(tmp_path / "run", AGENTS["robust"], "InvertedPendulum-v5")


def conducted(folder, console=QUIET, launcher="local"):
    """Its launcher's exit status."""
    folder.lock.take()
    return conduct(folder.config(), folder, LaunchOptions(folder.path, launcher=launcher), console)


def test_the_last_evaluation_judges_and_does_not_choose(folder):
    """The best is of those that were evaluated from other starts."""
    assert conducted(folder) == 0
    assert json.loads(folder.result_file.read_bytes())["updates"] == 7
    assert CheckpointFolder(folder.checkpoints).best() is None


def test_the_untrained_policy_is_played_once(folder, monkeypatch):
    """Its result is read at a resume; where that is damaged, it is played again."""
    played, play = [], evaluation.evaluate_policy

    def counted(policy, *others):
        played.append(policy)
        return play(policy, *others)

    monkeypatch.setattr(evaluation, "evaluate_policy", counted)

    def train() -> float:
        """How often a policy was played, with the last's; what the result says of the untrained one."""
        played.clear()
        folder.result_file.unlink(missing_ok=True)  # as where steps are missing
        assert conducted(folder) == 0
        return json.loads(folder.result_file.read_bytes())["initial_return_mean"]

    first = train()
    assert len(played) == 2
    kept = folder.initial_file.read_bytes()
    changed = {**json.loads(kept), "eval_return_mean": first + 1}  # told apart from one that is played
    folder.initial_file.write_text(json.dumps(changed))
    assert (train(), len(played)) == (first + 1, 1)
    for damaged in (b"", kept[:20], b"[]", b'{"eval_return_mean": "x"}', b"\xff"):
        folder.initial_file.write_bytes(damaged)
        assert (train(), len(played)) == (first, 2)
        assert folder.initial_file.read_bytes() == kept
    folder.initial_file.unlink()
    assert (train(), len(played)) == (first, 2)


def test_an_evaluation_without_end_shows_that_it_goes_on_and_is_cut(tmp_path, monkeypatch, capsys):
    folder = make_run(tmp_path / "run", AGENTS["robust"], "NeverEnding-v0")
    monkeypatch.setattr(training, "_launch", lambda *_: True)
    monkeypatch.setattr(evaluation, "SAY_SECONDS", 0.1)
    config, output, began = folder.config(), io.StringIO(), time.monotonic()
    config = replace(config, evaluator=replace(config.evaluator, evaluation_seconds=0.5))
    folder.lock.take()
    placement = LaunchOptions(folder.path)
    assert conduct(config, folder, placement, Console(file=output, width=200)) == 0
    assert 1.0 < time.monotonic() - began < 60
    for when in ("before training:", "after training:"):
        assert f"{when} episode 1 of 10, " in output.getvalue()
    assert output.getvalue().count("over 1 deterministic episode, cut when its seconds were over") == 3
    assert json.loads(folder.result_file.read_bytes())["eval_cut"] == 1
    assert main.run(["evaluate", str(folder.path), "--seconds", "0.5", "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["eval_cut"] == 1
    assert f"{folder.path}: episode 1 of 10, " in captured.err.replace("\n", "")
    assert main.run(["evaluate", str(folder.path), "--seconds", "nan"]) == 2
    assert "--seconds=nan: take 0 or more" in capsys.readouterr().err


def test_in_lockstep_no_clock_cuts_an_evaluation_and_none_counts_as_training(folder, monkeypatch):
    limits, begins, ends, play = [], [], [], evaluation.evaluate_policy

    def noted(policy, episodes, flicker, seconds, *others):
        limits.append(seconds)
        begins.append(time.monotonic())
        time.sleep(0.5)
        played = play(policy, episodes, flicker, seconds, *others)
        ends.append(time.monotonic())
        return played

    monkeypatch.setattr(evaluation, "evaluate_policy", noted)
    for launcher in ("lockstep", "local"):
        for file in (folder.initial_file, folder.result_file):
            file.unlink(missing_ok=True)
        assert conducted(folder, launcher=launcher) == 0
    assert limits == [0.0, 0.0, 300.0, 300.0]
    between = sum(begins[after] - ends[after - 1] for after in (1, 3))
    assert json.loads(folder.result_file.read_bytes())["wall_s"] < between


def test_it_imports_torch_without_its_compiler(tmp_path):
    """Which takes more than a second, of each learner that starts."""
    command = [sys.executable, "-c", TRAINS_AND_GOES_ON]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr


def test_a_stop_signal_amid_the_evaluations_stops_the_run(folder, monkeypatch):
    """There is no role yet, or no more."""
    before = signal.getsignal(signal.SIGTERM)
    for amid in ("_before", "_result"):
        with monkeypatch.context() as patch:
            patch.setattr(training, amid, lambda *_: signal.raise_signal(signal.SIGTERM))
            assert conducted(folder) == STOPPED_STATUS
        assert folder.lock.ended() == STOPPED_STATUS
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stop_signal_that_a_librarys_import_swallows_is_not_lost(number, folder, monkeypatch):
    played = {"eval_return_mean": 0.0, "eval_return_std": 0.0, "eval_episodes": 1}

    def swallowed(*_):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(number)
        return played

    monkeypatch.setattr(training, "_before", swallowed)
    monkeypatch.setattr(training, "_launch", lambda *given: not given[-1].requested)
    with signals_interrupt():  # as ``rmc`` has it for all of its process
        assert conducted(folder) == STOPPED_STATUS
        monkeypatch.setattr(training, "_before", lambda *_: played)
        assert conducted(folder) == 0  # another run has heard nothing


def test_a_stop_signal_before_the_first_word_stops_the_run(folder, monkeypatch):
    """Who waits for the lock hears that it was stopped, not that it was killed."""
    monkeypatch.setattr(training, "_conduct", lambda *_: signal.raise_signal(signal.SIGTERM))
    with pytest.raises(KeyboardInterrupt):
        conducted(folder)
    assert folder.lock.ended() == STOPPED_STATUS


def test_a_stop_signal_as_the_roles_end_leaves_out_the_last_evaluation(folder, monkeypatch):
    def ends(*given):
        given[-1].request()
        return True

    monkeypatch.setattr(training, "_launch", ends)
    monkeypatch.setattr(training, "_result", lambda *_: pytest.fail("it was evaluated"))
    assert conducted(folder) == STOPPED_STATUS


def test_an_ignored_signal_stays_ignored():
    """As a shell does with Ctrl-C of what it starts by &."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with signals_interrupt():
            signal.raise_signal(signal.SIGINT)
            with signals_caught() as stop:
                signal.raise_signal(signal.SIGINT)
                assert not stop.requested
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_run_that_goes_on_knows_its_steps_before_a_role_speaks(folder, monkeypatch):
    output = io.StringIO()
    folder.history_file.write_text(json.dumps({"time": 1.0, "version": "0", "env_steps": 1_400}) + "\n")
    for amid in ("_before", "_result"):
        with monkeypatch.context() as patch:
            patch.setattr(training, amid, lambda *_: signal.raise_signal(signal.SIGTERM))
            assert conducted(folder, Console(file=output, width=200)) == STOPPED_STATUS
    assert output.getvalue().count("stopped at step 1,400; to go on:") == 2


def test_a_finished_run_that_is_resumed_says_that_no_step_is_missing(folder):
    output, before = io.StringIO(), []
    for times in (0, 1):
        assert conducted(folder, Console(file=output, width=200)) == 0
        assert output.getvalue().count(f"steps are trained; rmc resume {folder.path} --total-steps N goes on") == times
        files = [path.read_bytes() for path in (folder.result_file, folder.metrics)]
        assert times == 0 or files == before
        before = files
    assert output.getvalue().count("after training:  return") == 2


def test_a_second_ctrl_c_amid_the_upload_leaves_no_lock(folder, monkeypatch):
    class Uploads:
        def close(self, _):
            raise KeyboardInterrupt

        def __getattr__(self, name):
            return lambda *_, **__: None

    monkeypatch.setattr(training, "start_tracker", lambda *_: Uploads())
    monkeypatch.setattr(training, "_launch", lambda *_: False)
    with pytest.raises(KeyboardInterrupt):
        conducted(folder)
    assert folder.lock.ended() == STOPPED_STATUS
    RunFolder(folder.path).lock.take()


def test_why_a_run_has_failed_stays_in_its_folder(folder, monkeypatch):
    def fail(*_):
        raise RoleDied("the learner ended 3 times")

    monkeypatch.setattr(training, "_launch", fail)
    with pytest.raises(RoleDied):
        conducted(folder)
    assert (folder.logs / "launcher.log").read_text() == "the learner ended 3 times\n"


def test_what_nobody_expected_stays_there_too(folder, monkeypatch):
    monkeypatch.setattr(training, "_launch", lambda *_: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        conducted(folder)
    text = (folder.logs / "launcher.log").read_text()
    assert text.startswith("Traceback")
    assert text.endswith("ZeroDivisionError: integer division or modulo by zero\n")


def test_another_users_words_do_not_reach_the_terminal_as_control_codes(folder):
    folder.lock.take()
    folder.lock.release(1)
    (folder.logs / "launcher.log").write_text("plain [1/2]\n\x1b]0;title taken\x07\x1b[2J\n")
    output = io.StringIO()
    with pytest.raises(RoleDied, match="ended with status 1"):
        print_end(folder, Console(file=output, width=200, markup=False, highlight=False))
    assert output.getvalue() == "plain [1/2]\n'\\x1b]0;title taken\\x07\\x1b[2J'\n"


def test_a_run_whose_launcher_was_killed_says_how_to_go_on(folder):
    with pytest.raises(RoleDied, match=rf"the launcher of \S+ was killed; to go on: rmc resume {folder.path}"):
        print_end(folder, QUIET)
