"""A policy outside of training: in a user's own loop, and as an ONNX file."""

import copy
import dataclasses
import itertools
import json
import pickle
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from gymnasium.envs.classic_control.pendulum import PendulumEnv
from gymnasium.spaces import Box
from safetensors.torch import load, save

from rmc import api
from rmc.actors.evaluator import first_start
from rmc.actors.policy_runner import one_thread
from rmc.analysis import policy as policy_module
from rmc.analysis.evaluation import evaluate_policy
from rmc.analysis.export import export
from rmc.analysis.policy import Policy, load_policy
from rmc.analysis.policy_file import read_policy
from rmc.analysis.run_evaluation import evaluate_run
from rmc.cli import main, policy_commands
from rmc.common.agent_config import AgentConfig
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.env.config import EnvConfig
from rmc.common.env.spaces import vector
from rmc.common.errors import STOPPED_STATUS, ConfigError
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.presets import debug
from tests.command import complaint
from tests.hiding import hide
from tests.runs import AGENTS, make_run, run_of


@pytest.fixture
def run(request: pytest.FixtureRequest, tmp_path: Path) -> RunFolder:
    """Of "robust", unless a test names others."""
    agent = AGENTS[getattr(request, "param", "robust")]
    return make_run(tmp_path / "run", agent, "Pendulum-v1", flicker=0.2)


of_each_agent = pytest.mark.parametrize("run", AGENTS, indirect=True)


@of_each_agent
def test_a_loop_of_ones_own_gives_what_an_evaluation_gives(run: RunFolder) -> None:
    policy = load_policy(run.path)
    env, returns = policy.make_env(), []
    for episode in range(3):
        observation, info = env.reset(seed=first_start(run.config().seed, final=True) + episode)
        policy.reset()
        total, ended = 0.0, False
        while not ended:
            action = policy.act(observation, info["missing"])
            assert action.shape == (1,)
            observation, reward, terminated, truncated, info = env.step(action)
            total, ended = total + float(reward), terminated or truncated
        returns.append(total)
    result = evaluate_policy(read_policy(run.path), episodes=3)
    assert np.mean(returns) == result["eval_return_mean"]


@contextmanager
def torch_of_anothers() -> Iterator[None]:
    """As a program has it that computes in float64, elsewhere."""
    threads = torch.get_num_threads()
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    torch.set_num_threads(2)
    try:
        yield
        assert (torch.get_default_dtype(), torch.get_default_device().type) == (torch.float64, "meta")
        assert torch.get_num_threads() == 2
    finally:
        torch.set_default_dtype(torch.float32)
        torch.set_default_device(None)
        torch.set_num_threads(threads)


def test_a_program_with_other_defaults_of_torch_keeps_them(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run", AGENTS["filling blanks"], "Pendulum-v1", flicker=0.2)
    with torch_of_anothers():
        policy = load_policy(folder.path)
        for _ in range(2):
            assert policy.act(np.zeros(3)).shape == (1,)
            policy.reset()
        assert api.evaluate(folder.path, episodes=1)["eval_episodes"] == 1
        config = dataclasses.replace(debug(EnvConfig("Pendulum-v1")), total_steps=600)
        assert api.train(config, tmp_path / "new", launcher="lockstep")["eval_episodes"] == 10


@of_each_agent
@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda policy: pickle.loads(pickle.dumps(policy))])
def test_a_copy_goes_on_as_the_first_does_and_changes_nothing_in_it(
    run: RunFolder, copied: Callable[[Policy], Policy]
) -> None:
    policy, alone = load_policy(run.path), load_policy(run.path)
    frames = np.random.default_rng(0).normal(size=(5, 2, 3))
    for frame in frames[:2]:
        assert (policy.act(frame, explore=True) == alone.act(frame, explore=True)).all()
    other = copied(policy)
    went_on = [[acts.act(frame, explore=True).tolist() for frame in frames[2:]] for acts in (other, policy, alone)]
    assert went_on[0] == went_on[1] == went_on[2]


def test_a_policy_that_began_in_inference_mode_acts_outside_of_it(run: RunFolder) -> None:
    policy = load_policy(run.path)
    with torch.inference_mode():
        policy.act(np.zeros(3))
    assert policy.act(np.zeros(3)).shape == (1,)


FORKS = """
import multiprocessing, sys
import numpy as np, torch
from rmc.analysis.policy import load_policy

def act():
    load_policy(sys.argv[1]).act(np.zeros((64, 17)))

torch.set_num_threads(2)
act()
child = multiprocessing.get_context("fork").Process(target=act)
child.start()
child.join(20)
child.kill()
child.join()
sys.exit(child.exitcode != 0)
"""


def test_a_process_that_has_a_policy_can_fork(tmp_path: Path) -> None:
    """Torch's threads do not: where any have begun, the child waits for them without end."""
    folder = make_run(tmp_path / "run", AgentConfig(normalize_observations=True), "HalfCheetah-v5").path
    assert subprocess.run([sys.executable, "-W", "ignore", "-c", FORKS, folder], check=False).returncode == 0


def test_two_that_act_at_once_leave_the_callers_threads_as_they_were() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(4)
    try:
        first, second = one_thread(), one_thread()
        with ThreadPoolExecutor(1) as other:
            other.submit(first.__enter__).result()
            second.__enter__()
            other.submit(first.__exit__, None, None, None).result()
            second.__exit__(None, None, None)
            assert (torch.get_num_threads(), other.submit(torch.get_num_threads).result()) == (4, 4)
    finally:
        torch.set_num_threads(before)


@of_each_agent
def test_a_reset_forgets_and_keeps_the_networks(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, frames = load_policy(run.path), np.random.default_rng(0).normal(size=(3, 3))
    first = [policy.act(frame) for frame in frames]
    with monkeypatch.context() as within:
        within.setattr(policy_module, "policy_runner", None)
        policy.reset()
        assert np.array_equal([policy.act(frame) for frame in frames], first)
    policy.reset()
    assert np.array_equal(policy.act(frames[:2]), load_policy(run.path).act(frames[:2]))  # of another number, too


def test_a_reset_of_no_number_is_refused(run: RunFolder) -> None:
    """What says that an episode is over, taken for a number, would be another one's."""
    policy = load_policy(run.path)
    indices: list[Any] = [True, False, np.True_, np.array([True]), [0], 1.0, "1"]
    for index in indices:
        with pytest.raises(ConfigError, match=r"^index=.*: give the number of an episode, or nothing for all$"):
            policy.reset(index)


def test_all_probabilities_are_played_by_one_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Though the run trains on, and saves another checkpoint meanwhile."""
    run = make_run(tmp_path / "run", AGENTS["robust"], "Pendulum-v1")

    def evaluate_and_save(*arguments: Any) -> dict[str, Any]:
        played = evaluate_run(*arguments)
        checkpoints = CheckpointFolder(run.checkpoints)
        header = dataclasses.replace(run.config().policy_header(), updates=8)
        files = checkpoints.load(7)
        policy = save(load(files["policy.safetensors"]), header.metadata())
        progress = json.dumps({"updates": 8, "env_steps": 80}).encode()
        checkpoints.save(8, files | {"policy.safetensors": policy, "progress.json": progress})
        return played

    monkeypatch.setattr(policy_commands, "evaluate_run", evaluate_and_save)
    assert main.run(["evaluate", str(run.path), "--episodes", "1", "--flicker", "0", "0.5", "--json"]) == 0
    assert [json.loads(line)["updates"] for line in capsys.readouterr().out.splitlines()] == [7, 7]


@pytest.mark.parametrize("episode", [0, 2])
def test_an_interrupt_prints_the_episodes_that_are_over(
    episode: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path / "run", AGENTS["robust"], "Pendulum-v1")
    steps, step = itertools.count(1), PendulumEnv.step

    def interrupted(env: PendulumEnv, action: Any) -> Any:
        if next(steps) == 200 * episode + 50:
            signal.raise_signal(signal.SIGINT)
        return step(env, action)

    monkeypatch.setattr(PendulumEnv, "step", interrupted)
    assert main.run(["evaluate", str(run.path), "--episodes", "9", "--flicker", "0", "0.5"]) == STOPPED_STATUS
    said = capsys.readouterr().out
    told = r"Pendulum-v1: return \S+ ± \S+ over 2 episodes, cut when it was stopped, after 70 steps\n"
    assert re.fullmatch(told if episode else "", said)  # and no other flicker is played


@pytest.mark.long
def test_an_evaluation_is_the_same_with_any_number_of_threads(tmp_path: Path) -> None:
    run = make_run(
        tmp_path / "run", AgentConfig(normalize_observations=True, impute_missing=True), "HalfCheetah-v5", 0.5
    )
    before, counts = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            counts.append(evaluate_policy(read_policy(run.path), episodes=10))
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert counts[0] == counts[1]


@of_each_agent
@pytest.mark.parametrize("odd", [np.nan, 1e300])
def test_a_frame_that_is_not_finite_is_missing_or_refused(run: RunFolder, odd: float) -> None:
    """Refused, it leaves no trace: the next action is as if it had not been there."""
    policy, other = load_policy(run.path), load_policy(run.path)
    first, bad, last = np.ones(3, np.float32), np.array([1.0, odd, 2.0]), np.full(3, 0.5, np.float32)
    assert (policy.act(first) == other.act(first)).all()
    if run.config().agent.impute_missing:
        assert (policy.act(bad) == other.act(first, missing=True)).all()
    else:
        with pytest.raises(ConfigError, match=r"observation=\{1: -?(nan|inf)\}: give finite numbers"):
            policy.act(bad)
    assert (policy.act(last) == other.act(last)).all()
    assert np.isfinite(policy.act(bad, missing=True)).all()


@pytest.mark.parametrize("run", ["plain"], indirect=True)
def test_a_reading_too_large_for_the_networks_is_refused_and_forgotten(run: RunFolder, tmp_path: Path) -> None:
    """Once in the memory, NaN would stay there until the episode's end."""
    whole, file = read_policy(run.path), tmp_path / "policy.safetensors"
    larger = {name: 20 * weight for name, weight in load(whole.blob).items()}  # as training makes them
    file.write_bytes(save(larger, whole.header.metadata()))
    policy, other = load_policy(file), load_policy(file)
    largest, refused = np.finfo(np.float32).max, 0
    for signs in itertools.product((-1, 0, 1), repeat=3):
        reading = largest * np.array(signs, np.float32)
        try:
            assert np.isfinite(policy.act(reading)).all()
        except ConfigError:
            refused += 1
            with pytest.raises(
                ConfigError, match=r"observation='up to 3.4e\+38': too large for this policy's networks"
            ):
                policy.act(reading)
        else:
            other.act(reading)
        assert (policy.act(np.ones(3)) == other.act(np.ones(3))).all()
    assert 0 < refused < 27


def test_a_program_that_raises_for_underflow_can_act(run: RunFolder) -> None:
    policy, other = load_policy(run.path), load_policy(run.path)
    with np.errstate(all="raise"):
        action = policy.act(np.full(3, 1e-50))
        assert (vector(Box(-1, 1, (3,), np.float64), np.full(3, 1e-50)) == 0).all()
    assert (action == other.act(np.zeros(3))).all()


def test_a_masked_array_is_refused(run: RunFolder) -> None:
    with pytest.raises(ConfigError, match=r"observation='a masked array': give its numbers, and missing=True for what"):
        load_policy(run.path).act(np.ma.masked_array([0.0, 9.0, 0.0], mask=[False, True, False]))


def test_a_stack_has_zeros_for_what_is_missing(tmp_path: Path) -> None:
    config = dataclasses.replace(debug(EnvConfig("Pendulum-v1", flicker=0.5, frame_stack=2)), agent=AGENTS["robust"])
    policy = load_policy(run_of(tmp_path / "run", config).path)
    with pytest.raises(ConfigError, match=r"missing=True: leave it: a missing frame is zeros in its place"):
        policy.act(np.ones(6), missing=True)
    with pytest.raises(ConfigError, match=r"observation={1: nan}: give finite numbers, or zeros where there is none"):
        policy.act(np.array([1.0, np.nan, 0.0, 0.0, 0.0, 0.0]))
    assert np.isfinite(policy.act(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))).all()


@pytest.mark.parametrize(
    ("observations", "says"),
    [
        ([np.ones(1), np.ones(4), 1.0, np.ones((2, 4)), np.ones((0, 3)), np.ones((1, 1, 3)), None], r"'of .*\(3,\)"),
        (
            [{"x": [1.0]}, torch.ones(3, requires_grad=True), "text", [[1.0], [1.0, 2.0]]],
            ".*: give 3 numbers, as policy.make_env",
        ),
    ],
)
def test_what_is_no_observation_is_refused(run: RunFolder, observations: list[Any], says: str) -> None:
    policy = load_policy(run.path)
    for observation in observations:
        with pytest.raises(ConfigError, match=f"^observation={says}"):
            policy.act(observation)


def test_flags_of_several_lengths_are_refused(run: RunFolder) -> None:
    with pytest.raises(ConfigError, match=r"missing=.*: give one, or one for each of 1 rows"):
        load_policy(run.path).act(np.ones(3), [[True], [True, False]])  # type: ignore[arg-type]


def test_flags_that_are_text_are_refused(run: RunFolder) -> None:
    policy = load_policy(run.path)
    words: list[Any] = ["yes", ["False"], b""]
    for missing in words:
        with pytest.raises(ConfigError, match=r"^missing=.*: give True or False, not text$"):
            policy.act(np.ones(3), missing)


@pytest.mark.parametrize(("env", "shape"), [("Column-v0", (2, 1)), ("Row-v0", (1, 2))])
def test_an_observation_may_have_the_environments_own_shape(env: str, shape: tuple[int, int], tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", AGENTS["robust"], f"tests.odd_envs:{env}").path
    own = np.array([0.1, 0.2], np.float32).reshape(shape)
    assert (load_policy(run).act(own) == load_policy(run).act(own.ravel())).all()
    assert load_policy(run).act(own).ndim == 1


def test_exploring_actions_vary_and_are_seeded(run: RunFolder) -> None:
    observation = np.ones(3, np.float32)
    assert load_policy(run.path).act(observation, explore=True) != load_policy(run.path, seed=1).act(
        observation, explore=True
    )
    actions = [[load_policy(run.path).act(observation, explore=explore) for _ in range(2)] for explore in (False, True)]
    assert actions[0][0] == actions[0][1]
    assert actions[1][0] == actions[1][1]
    assert actions[0][0] != actions[1][0]


@pytest.mark.parametrize(
    "run",
    [pytest.param(one, marks=[pytest.mark.long] * (one in ("plain", "observation beside"))) for one in AGENTS],
    indirect=True,
)
def test_onnx_acts_alike(run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "policy.onnx"
    assert main.run(["export", str(run.path), "--out", str(file)]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert "inputs observation, previous_action, missing, state; outputs action, next_state" in line
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    rng, policy = np.random.default_rng(0), load_policy(run.path)
    assert session.get_modelmeta().custom_metadata_map == policy.header.metadata()
    feed = {
        "previous_action": np.zeros((3, 1), np.float32),
        "state": np.zeros((3, run.config().window_spec().state), np.float32),
    }
    for step in range(20):  # three rows, though it was traced with two; the first one beside the policy
        observation, missing = rng.normal(size=(3, 3)).astype(np.float32), np.array([step % 5 == 2, False, True])
        action, state = session.run(None, {"observation": observation, "missing": missing, **feed})
        np.testing.assert_allclose(action[0], policy.act(observation[0], bool(missing[0])), atol=1e-5)
        feed = {"previous_action": action, "state": state}
    if run.config().agent.impute_missing:
        observation[1, 2] = np.nan
        actions = [
            session.run(None, {"observation": seen, "missing": np.array([False, missing, False]), **feed})
            for seen, missing in ((observation, False), (np.nan_to_num(observation), True))
        ]
        np.testing.assert_array_equal(actions[0][0], actions[1][0])
        np.testing.assert_array_equal(actions[0][1], actions[1][1])


def test_onnx_takes_nothing_in_a_stack_for_missing(tmp_path: Path) -> None:
    """It fills no whole stack for one number, as it never did in training."""
    config = dataclasses.replace(debug(EnvConfig("Pendulum-v1", frame_stack=2)), agent=AGENTS["filling blanks"])
    policy, out = read_policy(run_of(tmp_path / "run", config).path), tmp_path / "policy.onnx"
    export(policy, out)
    session = onnxruntime.InferenceSession(str(out), providers=["CPUExecutionProvider"])
    sizes = policy.header.sizes()
    feed = {
        name: np.zeros((1, sizes[name.removeprefix("previous_")]), np.float32) for name in ("previous_action", "state")
    }
    seen = np.array([[np.nan, 1.0, 0.0, 0.0, 0.0, 0.0]], np.float32)
    odd, filled = (
        session.run(None, {"observation": frame, "missing": np.array([missing]), **feed})[0]
        for frame, missing in ((seen, False), (np.nan_to_num(seen), True))
    )
    assert (odd != filled).all()


def test_an_environment_that_says_by_number_what_is_missing_since_is_refused(tmp_path: Path) -> None:
    by_frame = {"missing": "frame"}
    run = make_run(tmp_path / "run", AGENTS["robust"], "tests.partial_env:Partial-v0", env_kwargs=by_frame)
    policy = read_policy(run.path)
    evaluate_policy(policy, 1)
    env = dataclasses.replace(policy.header.env, env_kwargs={"missing": "number"})
    changed = dataclasses.replace(policy, header=dataclasses.replace(policy.header, env=env))
    with pytest.raises(ConfigError, match=r"the environment now gives 3, the policy reads 1; undo that"):
        evaluate_policy(changed, 1)


def test_export_says_what_is_wrong_in_one_line(
    run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["export", str(run.path)]
    assert "its folder is not there" in complaint([*words, "--out", str(tmp_path / "no" / "policy.onnx")], capsys)
    assert "is a folder" in complaint([*words, "--out", str(tmp_path)], capsys)
    assert "none was evaluated whole yet" in complaint([*words, "--checkpoint", "best"], capsys)
    assert "use latest, best or one of [7]" in complaint([*words, "--checkpoint", "²"], capsys)
    assert "cannot be written" in complaint([*words, "--out", "/proc/policy.onnx"], capsys)
    (tmp_path / ".policy.onnx").mkdir()  # in the way of what has that name until it is whole
    assert f"'{tmp_path}/policy.onnx': cannot" in complaint([*words, "--out", str(tmp_path / "policy.onnx")], capsys)
    hide("onnxscript", monkeypatch)
    assert "pip install -e '.[onnx]' in /" in complaint(words, capsys)


def test_another_environments_policy_is_refused(run: RunFolder, tmp_path: Path, capsys) -> None:
    """Its parts have other shapes; or there are fewer, which torch would leave at random."""
    file, other = tmp_path / "policy.onnx", make_run(tmp_path / "other", run.config().agent, "InvertedPendulum-v5")
    fewer = load(CheckpointFolder(run.checkpoints).load(7)["policy.safetensors"])
    del fewer["policy.net.4.bias"]
    theirs = CheckpointFolder(other.checkpoints).load(7)
    for blob in (theirs["policy.safetensors"], save(fewer)):
        CheckpointFolder(run.checkpoints).save(8, theirs | {"policy.safetensors": blob})
        for words in (["export", str(run.path), "--out", str(file)], ["evaluate", str(run.path), "--episodes", "1"]):
            assert "--checkpoint='latest': weights: not a policy of this run" in complaint(words, capsys)
    assert not file.exists()
