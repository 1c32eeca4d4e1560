"""A policy's file: all that it takes to act, and judged before anything acts on it."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from safetensors.torch import load, save

from rmc.analysis.policy import Policy, load_policy
from rmc.analysis.policy_file import read_policy
from rmc.cli import main
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.env.spaces import parts
from rmc.common.errors import ConfigError
from rmc.common.policy_header import METADATA_KEY
from rmc.deploy.run.folder import RunFolder
from tests.command import complaint
from tests.runs import AGENTS, make_run


class Joints(gym.Env[Any, Any]):
    """A Dict of observations; actions in units, dtype and shape of its own."""

    observation_space = gym.spaces.Dict(
        angle=gym.spaces.Box(-3, 3, (2,), np.float64), inner=gym.spaces.Dict(speed=gym.spaces.Box(-9, 9, (1,)))
    )
    action_space = gym.spaces.Box(np.array([[0.0], [-10.0]]), np.array([[4.0], [30.0]]), (2, 1), np.float64)

    def __init__(self) -> None:
        self.taken: list[np.ndarray] = []

    def _seen(self) -> Any:
        values = self.np_random.normal(size=3)
        return {"angle": values[:2], "inner": {"speed": values[2:].astype(np.float32)}}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._seen(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.taken.append(action)
        return self._seen(), 1.0, False, False, {}


gym.register("Joints-v0", entry_point=Joints, max_episode_steps=10)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A policy that left its run."""
    out = tmp_path / "policy.safetensors"
    run = make_run(tmp_path / "run", AGENTS["filling blanks"], "Joints-v0")
    assert main.run(["export", str(run.path), "--out", str(out)]) == 0
    return out


def changed(file: Path, change: Callable[[dict[str, Any]], Any]) -> Path:
    """The same file with a header that was tampered with; ``change`` may give another."""
    blob = file.read_bytes()
    text = json.loads(blob[8 : 8 + int.from_bytes(blob[:8], "little")])["__metadata__"][METADATA_KEY]
    facts = json.loads(text)
    other = change(facts)
    file.write_bytes(save(load(blob), {METADATA_KEY: json.dumps(facts if other is None else other)}))
    return file


def test_a_file_is_all_that_it_takes(tmp_path: Path) -> None:
    """Without its run, and where the module of its environment is not there."""
    run = make_run(tmp_path / "run", AGENTS["robust"], "tests.habits:Slide-v0")
    (blob,) = run.checkpoints.glob("*/policy.safetensors")  # a copy is enough
    alone = tmp_path / "alone"
    alone.mkdir()
    (alone / "policy.safetensors").write_bytes(blob.read_bytes())
    expected = load_policy(run.path).act([0.5, -1.0, 2.0]).tolist()
    run.path.rename(tmp_path / "gone")
    code = """
import rmc
policy = rmc.load_policy("policy.safetensors")
print(policy.act([0.5, -1.0, 2.0]).tolist(), policy.header.env_steps)
try:
    policy.make_env()
except rmc.ConfigError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=alone, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    acted, refused = done.stdout.splitlines()
    assert acted == f"{expected} 70"
    assert refused.startswith("ENV='tests.habits:Slide-v0': No module named 'tests'; start from the folder that")


def test_a_checkpoints_file_and_its_run_say_the_same(file: Path, tmp_path: Path) -> None:
    run = load_policy(tmp_path / "run")
    alone = load_policy(file)
    assert alone.header == run.header
    assert (alone.header.env.id, alone.header.env_steps, alone.header.updates) == ("Joints-v0", 70, 7)
    assert alone.header.layout.observations == parts(Joints.observation_space)
    assert [part.name for part in alone.header.layout.observations] == ["angle", "inner.speed"]
    assert alone.header.eval_return_mean is None
    observation = np.array([0.1, 0.2, 0.3])
    for _ in range(3):
        assert (run.act(observation) == alone.act(observation)).all()


@pytest.mark.parametrize("result", [False, True])
def test_the_return_is_that_of_the_checkpoint(tmp_path: Path, result: bool) -> None:
    """Of the newest evaluation of that very checkpoint; the run's last one, if it is of the same."""
    run = make_run(tmp_path / "run", AGENTS["robust"], "Pendulum-v1")
    for update, mean in ((7, -3.0), (7, -2.0), (8, -1.0)):
        record = {"role": "evaluator", "eval_update": update, "eval_return_mean": mean, "eval_return_std": 0.5}
        with run.metrics.open("a") as lines:
            lines.write(json.dumps(record | {"eval_episodes": 5}) + "\n")
    if not result:
        with run.metrics.open("a") as lines:  # by an evaluator that was started again
            cut = record | {"eval_update": 7, "eval_return_mean": -9.0, "eval_episodes": 1, "eval_cut": 1}
            lines.write(json.dumps(cut) + "\n")
    if result:
        played = {"eval_return_mean": -4.0, "eval_return_std": 0.25, "eval_episodes": 10, "initial_return_mean": 0.0}
        run.write_result(played | {"env_steps": 70, "updates": 7, "wall_s": 1.0})
    header = read_policy(run.path).header
    evaluation = header.eval_return_mean, header.eval_return_std, header.eval_episodes
    assert evaluation == ((-4.0, 0.25, 10) if result else (-2.0, 0.5, 5))


def test_the_last_evaluation_does_not_count_where_it_was_cut(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", AGENTS["robust"], "Pendulum-v1")
    played = {"eval_return_mean": -3.0, "eval_return_std": 0.5, "eval_episodes": 5}
    run.metrics.write_text(json.dumps({"role": "evaluator", "eval_update": 7} | played) + "\n")
    cut = played | {"eval_return_mean": -4.0, "eval_episodes": 1, "eval_cut": 1}
    run.write_result(cut | {"env_steps": 70, "updates": 7, "wall_s": 1.0, "initial_return_mean": 0.0})
    assert read_policy(run.path).header.eval_return_mean == -3.0


def test_an_evaluation_that_was_cut_is_no_return(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", AGENTS["robust"], "Pendulum-v1")
    record = {"role": "evaluator", "eval_update": 7, "eval_return_mean": -3.0, "eval_return_std": 0.0}
    run.metrics.write_text(json.dumps(record | {"eval_episodes": 1, "eval_cut": 1}) + "\n")
    assert read_policy(run.path).header.eval_return_mean is None


def test_an_older_runs_policy_is_given_its_header(tmp_path: Path) -> None:
    new, older = (make_run(tmp_path / str(header), AGENTS["robust"], "Joints-v0", header=header) for header in (1, 0))
    assert read_policy(older.path).header == read_policy(new.path).header
    assert main.run(["export", str(older.path), "--out", str(tmp_path / "older.safetensors")]) == 0
    assert load_policy(tmp_path / "older.safetensors").header == load_policy(new.path).header


def test_actions_in_the_environments_own_units_are_what_it_is_given_in_training(file: Path) -> None:
    policy, env, bare = load_policy(file), load_policy(file).make_env(), Joints()
    seen, _ = env.reset(seed=3)
    observation, _ = bare.reset(seed=3)
    other = load_policy(file)
    for _ in range(5):
        seen, *_ = env.step(policy.act(seen))
        flat = np.concatenate([observation["angle"], observation["inner"]["speed"]])
        action = other.act(flat, units="environment")
        assert action in Joints.action_space
        observation, *_ = bare.step(action)
    ours, theirs = env.unwrapped.taken, bare.taken  # type: ignore[attr-defined]
    assert [action.tolist() for action in ours] == [action.tolist() for action in theirs]
    assert other.act(np.zeros((1, 3)), units="environment").shape == (1, 2, 1)
    with pytest.raises(ConfigError, match="units='metres': use one of"):
        other.act(flat, units="metres")  # type: ignore[call-overload]


def test_a_dictionary_of_actions_comes_in_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    two = gym.spaces.Dict(left=gym.spaces.Box(0, 2, (1,)), right=gym.spaces.Box(-8, 0, (2,), np.float64))
    monkeypatch.setattr(Joints, "action_space", two)
    policy = load_policy(make_run(tmp_path / "run", AGENTS["robust"], "Joints-v0").path)
    action = policy.act([0.0, 0.0, 0.0], units="environment")
    assert (action.shape, action.dtype) == ((3,), np.float64)
    assert [part.name for part in policy.header.layout.actions] == ["left", "right"]
    assert 0 < action[0] < 2
    assert (action[1:] > -8).all()
    assert (action[1:] < 0).all()


def test_so_does_a_dictionary_or_a_tuple_of_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    box = gym.spaces.Box(0, 2, (2, 3))
    for space, shape in ((gym.spaces.Dict(arm=box), (6,)), (gym.spaces.Tuple([box]), (6,)), (box, (2, 3))):
        monkeypatch.setattr(Joints, "action_space", space)
        policy = load_policy(make_run(tmp_path / type(space).__name__, AGENTS["robust"], "Joints-v0").path)
        action = policy.act([0.0, 0.0, 0.0], units="environment")
        assert (action.shape, action.dtype) == (shape, np.float32)


@pytest.mark.parametrize("agent", AGENTS)
def test_a_batch_is_as_many_policies(agent: str, tmp_path: Path) -> None:
    """Each with its own memory, missing frames and episodes' starts."""
    run, rng = make_run(tmp_path / "run", AGENTS[agent], "Joints-v0"), np.random.default_rng(0)
    batch, single = load_policy(run.path), [load_policy(run.path) for _ in range(3)]
    for step in range(8):
        observation, missing = rng.normal(size=(3, 3)), rng.random(3) < 0.3
        if step == 4:
            batch.reset(1)
            single[1].reset()
        actions = batch.act(observation, missing)
        assert actions.shape == (3, 2)
        for row in range(3):
            alone = single[row].act(observation[row], bool(missing[row]))
            np.testing.assert_allclose(actions[row], alone, atol=1e-6)
    batch.reset()
    assert batch.act(np.zeros((2, 3)), explore=True).shape == (2, 2)


def test_another_number_of_episodes_wants_a_reset(file: Path) -> None:
    policy, other = load_policy(file), load_policy(file)
    policy.reset(5)  # nothing has begun
    first = policy.act(np.ones((2, 3)))
    for observation in (np.ones(3), np.ones((3, 3))):
        with pytest.raises(ConfigError, match=r"acts in 2 episodes; reset\(\) it before"):
            policy.act(observation)
    with pytest.raises(ConfigError, match=r"missing='of shape .3,.': give one, or one for each of 2 rows"):
        policy.act(np.ones((2, 3)), np.zeros(3, bool))
    with pytest.raises(ConfigError, match="index=2: the policy acts in 2 episodes"):
        policy.reset(2)
    assert (first == other.act(np.ones((2, 3)))).all()
    assert (policy.act(np.ones((2, 3))) == other.act(np.ones((2, 3)))).all()  # what was refused left no trace
    policy.reset()
    assert policy.act(np.ones(3)).shape == (2,)


def test_what_is_not_finite_is_named_by_row(tmp_path: Path) -> None:
    policy = load_policy(make_run(tmp_path / "run", AGENTS["robust"], "Joints-v0").path)
    observation = np.array([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]])
    with pytest.raises(ConfigError, match=r"observation=\{\(1, 1\): nan\}: give finite numbers, or missing=True"):
        policy.act(observation)
    assert policy.act(observation, np.array([False, True])).shape == (2, 2)


def _set(*path: Any, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(facts: Any) -> None:
        for name in path[:-1]:
            facts = facts[name]
        facts[path[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_set("format", value=99), "newer policy: RMC 0.1.0 wrote format 99, this one reads up to "),
        (lambda facts: facts | {"format": 99, "rmc": "a\nb"}, "newer policy: RMC a b wrote format 99, this one reads"),
        (_set("sizes", value="a\nb"), r"damaged header: its sizes are 'a\nb', "),
        (_set("format", value=0), "damaged header: its format is 0"),
        (_set("format", value="1"), "damaged header: its format is '1'"),
        (_set("agent", "hidden", value=32), "damaged header: its sizes are"),
        (_set("sizes", value=None), "damaged header: its sizes are None"),
        (_set("layout", "frames", value=2), "damaged header: its sizes are"),
        (_set("layout", "action_low", value=[0.0]), "layout action_low=(0.0,): must lie below action_high"),
        (_set("agent", "embedding", value=10**9), "other sizes than its header's: memory.embed.0.bias has shape (12,)"),
        (_set("agent", "embedding", value=-3), "damaged header: no networks have its sizes"),
        (_set("agent", "embedding", value=10**40), "damaged header: no networks have its sizes"),
        (_set("agent", "layer_norm", value=True), "agent.layer_norm=True: no such option in this version"),
        (_set("agent", "heads", value=[10, "9"]), "header of another version: RMC 0.1.0 wrote it; agent.heads='9'"),
        (_set("agent", "rotary", value=True), "agent.rotary=True: no such option in this version"),
        (_set("env", value=3), "env=3: must be an object"),
        (_set("env", "id", value="a\x1b[31m"), "ENV='a\\x1b[31m': give an id of characters that can be seen"),
        (_set("env", "flicker", value=7.0), "--flicker=7.0: take a number from 0 to 1"),
        (_set("preset", value="\x1b]0;owned\x07"), "preset='\\x1b]0;owned\\x07': must be of characters"),
        (_set("seed", value=-5), "seed=-5: take a whole number from 0"),
        (_set("env_steps", value=-1), "env_steps=-1: take a whole number from 0"),
        (_set("eval_return_mean", value=float("nan")), "eval_return_mean=nan: must be finite"),
        (lambda facts: [facts], "is no object; copy it again"),
    ],
)
def test_a_header_that_does_not_fit_is_one_line(
    file: Path, change: Callable[[dict[str, Any]], Any], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    line = complaint(["evaluate", str(changed(file, change))], capsys)
    assert line.startswith(f"rmc: policy file='{file}': ")
    assert says in line


def test_an_older_header_is_read_in_todays_words(file: Path) -> None:
    """With the migrations of config.json: as if format 1 had had headers."""

    def older(facts: dict[str, Any]) -> None:
        facts["format"] = 1
        facts["agent"]["fill_blanks"] = facts["agent"].pop("impute_missing")
        facts["agent"]["blank_flag"] = facts["agent"].pop("missing_flag")
        del facts["env"]["env_kwargs"]

    before = load_policy(file).header
    assert before.agent.impute_missing
    assert load_policy(changed(file, older)).header == before


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (lambda blob: blob[:-1], "cut, or no safetensors file: "),
        (lambda blob: blob[:100], "cut, or no safetensors file: "),
        (lambda _: b"", "cut, or no safetensors file: "),
        (lambda _: b"PK\x03\x04 a zip, or anything", "cut, or no safetensors file: "),
        (lambda blob: save(load(blob)), "no policy: its metadata has no rmc.policy; give the folder of its run"),
        (lambda blob: save(load(blob), {METADATA_KEY: "{"}), "damaged header: no JSON"),
        (lambda blob: save(load(blob), {METADATA_KEY: "[" * 10**5}), "damaged header: no JSON"),
    ],
)
@pytest.mark.parametrize("command", ["evaluate", "export"])
def test_what_is_no_policy_is_one_line(
    file: Path, content: Callable[[bytes], bytes], says: str, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    file.write_bytes(content(file.read_bytes()))
    out = ["--out", str(file.with_suffix(".onnx"))] if command == "export" else []
    assert says in complaint([command, str(file), *out], capsys)
    assert not file.with_suffix(".onnx").exists()


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("policy.onnx", "it is for onnxruntime; give its run, or what rmc export RUN --out policy.safetensors writes"),
        ("config.json", "no policy's file; give a run's folder or a policy.safetensors"),
        ("learner.pt", "a learner's state; give its run's folder, or the policy.safetensors beside it"),
    ],
)
def test_a_file_of_another_format_is_not_called_damaged(name: str, says: str, file: Path) -> None:
    other = file.with_name(name)
    other.write_bytes(b"\x08\x08 what is no policy")
    with pytest.raises(ConfigError, match=f"^policy file='{other}': {says}$"):
        load_policy(other)
    assert load_policy(file.rename(file.with_suffix(".bak"))).header.env_steps == 70


def test_a_damaged_result_leaves_the_policy_as_it_is(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", AGENTS["robust"], "Pendulum-v1")
    run.result_file.write_text("{")
    assert load_policy(run.path).header.returns() == ""


def test_weights_that_are_not_finite_are_refused(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    blob = file.read_bytes()
    weights = load(blob)
    weights["policy.net.4.bias"][0] = np.nan
    facts = json.loads(blob[8 : 8 + int.from_bytes(blob[:8], "little")])["__metadata__"]
    file.write_bytes(save(weights, facts))
    assert "policy.net.4.bias holds NaN or infinity" in complaint(["evaluate", str(file)], capsys)


def test_a_file_is_played_and_exported_as_its_run_is(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    errors, out = [], tmp_path / "again.safetensors"
    for source in (file, tmp_path / "run"):
        assert main.run(["evaluate", str(source), "--episodes", "2", "--json"]) == 0
        errors.append(json.loads(capsys.readouterr().out.splitlines()[-1]))
        assert main.run(["export", str(source), "--out", str(out)]) == 0
        assert out.read_bytes() == file.read_bytes()
    assert errors[0] == errors[1]
    assert "Joints-v0 after 70 steps, not evaluated" in capsys.readouterr().out.replace("\n", "")
    assert "--checkpoint='7': " in complaint(["evaluate", str(file), "--checkpoint", "7"], capsys)
    assert "cannot be read" in complaint(["evaluate", str(tmp_path / "none.safetensors")], capsys)


def test_a_resume_with_more_time_for_the_environment_reaches_older_checkpoints(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run", AGENTS["robust"], "InvertedPendulum-v5")
    config = folder.config()
    folder.write_config(replace(config, env=replace(config.env, env_timeout=300.0)))
    assert read_policy(folder.path).header.env.env_timeout == 300.0


def test_a_run_keeps_no_other_environments_policy(tmp_path: Path) -> None:
    run, other = (make_run(tmp_path / env, AGENTS["robust"], env) for env in ("Joints-v0", "Pendulum-v1"))
    CheckpointFolder(run.checkpoints).save(8, CheckpointFolder(other.checkpoints).load(7))
    with pytest.raises(ConfigError, match=r"--checkpoint='latest': weights: not a policy of this run \(but of Pend"):
        load_policy(run.path)
    assert isinstance(load_policy(RunFolder(run.path).path, "7"), Policy)
