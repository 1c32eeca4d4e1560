"""A run that begins with another's networks: what its learner publishes first, and what is refused."""

import dataclasses
import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch

from rmc.analysis.policy_file import read_policy
from rmc.cli import main
from rmc.common.agent_config import POLICY_PARTS
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.common.replay import ObservationStatistics
from rmc.deploy.local.lockstep import Lockstep
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import InitParts, LaunchOptions
from rmc.deploy.run.opening import open_run
from rmc.deploy.run.presets import debug
from rmc.deploy.run.run_lock import RunLock
from rmc.deploy.run.starts import format_starts
from tests.deploy.test_config import with_value
from tests.integration.test_lockstep import trained
from tests.runs import untrained

ENV = EnvConfig("InvertedPendulum-v5")
CONFIG = dataclasses.replace(
    debug(ENV),
    total_steps=1_200,
    agent=dataclasses.replace(debug(ENV).agent, hidden=8, embedding=8, heads=(8, 8), normalize_observations=True),
    update=dataclasses.replace(debug(ENV).update, policy_ema_updates=100),
)
OTHER = dataclasses.replace(CONFIG, seed=7)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run that has learnt something, in lockstep."""
    folder = open_run(CONFIG, LaunchOptions(tmp_path_factory.mktemp("source") / "run", "fail"))
    trained(CONFIG, folder.path)
    folder.lock.release()
    return folder


def state(folder: RunFolder) -> dict[str, dict[str, torch.Tensor]]:
    newest = CheckpointFolder(folder.checkpoints).latest()
    assert newest is not None
    loaded: dict[str, dict[str, torch.Tensor]] = torch.load(io.BytesIO(newest[1]["learner.pt"]), weights_only=True)
    return loaded


def begin(config: RunConfig, path: Path, source: RunFolder, parts: InitParts = "all", which: str = "") -> RunFolder:
    options = LaunchOptions(path, init_from=f"{source.path}{which}", init_parts=parts)
    folder = open_run(config, options)
    folder.lock.release()
    return folder


def published(run: Lockstep) -> dict[str, torch.Tensor]:
    newest = run.bus.weights()
    assert newest is not None
    weights: dict[str, torch.Tensor] = safetensors.torch.load(newest[1])
    return weights


@pytest.mark.parametrize("parts", ["all", "policy", "memory+world-model"])
def test_the_first_published_weights_are_the_sources(parts: InitParts, source: RunFolder, tmp_path: Path) -> None:
    theirs, plain = state(source)["agent"], Lockstep(OTHER, tmp_path / "plain")
    ours = published(plain)
    folder = begin(OTHER, tmp_path / "run", source, parts)
    for _ in range(2):  # the second is a learner that was killed before its first checkpoint
        run = Lockstep(OTHER, folder.path)
        first = published(run)
        version = run.bus.latest_version()
        assert version is not None
        assert (version.update > 0) == (parts != "memory+world-model")  # with 0 actors do not ask the policy
        run.close()
        assert first.keys() == ours.keys()
        for name, value in first.items():
            from_source = name.startswith(("normalizer.", "memory.")) or parts != "memory+world-model"
            assert torch.equal(value, theirs[name] if from_source else ours[name]), name
    assert any(not torch.equal(theirs[name], ours[name]) for name in ours if name.startswith("policy."))
    plain.close()


@pytest.mark.parametrize("parts", ["all", "policy", "memory+world-model"])
def test_what_is_not_taken_is_the_runs_own(parts: InitParts, source: RunFolder, tmp_path: Path) -> None:
    plain = Lockstep(OTHER, tmp_path / "plain")
    ours, theirs = plain.learner.update.state_dict(), state(source)
    begun = state(begin(OTHER, tmp_path / "run", source, parts))
    predicts = ("normalizer.", "memory.", "world_model.")
    taken = {"all": ("",), "policy": POLICY_PARTS, "memory+world-model": predicts}[parts]
    for name, value in begun["agent"].items():
        expected = theirs if name.startswith(taken) else ours
        assert torch.equal(value, expected["agent"][name]), name
    for part, module in (("target_critic", "critic"), ("target_memory", "memory")):
        for name, value in begun[part].items():
            from_source = parts == "all" and part == "target_critic"  # not all runs move a target memory
            expected_value = theirs[part][name] if from_source else begun["agent"][f"{module}.{name}"]
            assert torch.equal(value, expected_value), name
    for name, value in begun["average"].items():
        expected = theirs["average"] if name.startswith(taken) else begun["agent"]
        assert torch.equal(value, expected[name]), name
    assert all(not optimizer["state"] for optimizer in begun["optimizers"])  # they begin anew
    plain.close()


def test_the_normaliser_goes_on_from_the_sources(source: RunFolder, tmp_path: Path) -> None:
    """At the first update it is that of both runs' observations, and so it is after a restart."""
    theirs = state(source)["agent"]["normalizer.mean"].double()
    folder = begin(OTHER, tmp_path / "run", source)
    assert read_policy(folder.path, "0").header == OTHER.policy_header()
    run = Lockstep(OTHER, folder.path)
    while not run.learner.last_checkpoint:
        run.step()
    run.close()
    for _ in range(2):
        run = Lockstep(OTHER, folder.path)
        run.learner.publish()
        own = run.server.statistics()
        mean = (theirs * 1_200 + torch.from_numpy(own.total)) / (1_200 + int(own.count[0]))
        run.close()
        torch.testing.assert_close(published(run)["normalizer.mean"], mean.float(), atol=1e-3, rtol=1e-3)


def test_the_sums_behind_the_normaliser_are_of_the_sources_mean_and_deviation(
    source: RunFolder, tmp_path: Path
) -> None:
    theirs = state(source)["agent"]
    newest = CheckpointFolder(begin(OTHER, tmp_path / "run", source).checkpoints).latest()
    assert newest is not None
    observed = ObservationStatistics.from_json(json.loads(newest[1]["progress.json"])["observed_before"])
    mean, std = (theirs[f"normalizer.{name}"].double().numpy() for name in ("mean", "std"))
    np.testing.assert_allclose(observed.total / observed.count, mean, rtol=1e-9)
    np.testing.assert_allclose(observed.total_square / observed.count, std**2 + mean**2, rtol=1e-9)


def test_a_number_that_the_source_never_saw_begins_anew(source: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(source.path, tmp_path / "source")
    blind = RunFolder(tmp_path / "source")
    learnt, checkpoints, file = state(blind), CheckpointFolder(blind.checkpoints), io.BytesIO()
    learnt["agent"]["normalizer.mean"][1], learnt["agent"]["normalizer.std"][1] = 0.0, 1.0
    torch.save(learnt, file)
    newest = checkpoints.latest()
    assert newest is not None
    checkpoints.save(newest[0] + 1, {**newest[1], "learner.pt": file.getvalue()})
    by_number = dataclasses.replace(OTHER, env=dataclasses.replace(ENV, drop_sensors=0.1))
    first = CheckpointFolder(begin(by_number, tmp_path / "run", blind).checkpoints).latest()
    assert first is not None
    assert json.loads(first[1]["progress.json"])["observed_before"]["count"] == [1_200, 0, 1_200, 1_200]


def test_the_normaliser_of_a_source_that_has_not_begun_is_its_own_sources(source: RunFolder, tmp_path: Path) -> None:
    first = begin(OTHER, tmp_path / "first", source)
    second = begin(OTHER, tmp_path / "second", first)
    newest = (CheckpointFolder(folder.checkpoints).latest() for folder in (first, second))
    numbers = [json.loads(one[1]["progress.json"]) for one in newest if one is not None]
    assert numbers[0]["observed_before"] == numbers[1]["observed_before"]
    assert len(numbers) == 2


def test_a_numbered_checkpoint_and_the_history(source: RunFolder, tmp_path: Path) -> None:
    numbers = CheckpointFolder(source.checkpoints).numbers()
    folder = begin(OTHER, tmp_path / "run", source, "policy", f":{numbers[0]}")
    assert format_starts(folder) == f"1 start; began with policy of {source.path}, update {numbers[0]}"
    begin(OTHER, folder.path, source, "policy", f":{numbers[0]}")  # the same words again go on
    with pytest.raises(
        ConfigError, match=r"--init-from='.*': the run in .* began with --init-from .* --init-parts policy; leave"
    ):
        begin(OTHER, folder.path, source, "all")
    assert format_starts(folder).startswith("2 starts; began with policy of ")


class Killed(Exception):
    """The start."""


@pytest.mark.parametrize("before", ["take", "reopen", "write_config", "write_sizes"])
def test_a_start_that_is_killed_is_made_again_by_the_same_words(
    before: str, source: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed: list[RunLock] = []

    def kill(place: RunFolder | RunLock, *_: object) -> None:
        killed.append(place if isinstance(place, RunLock) else place.lock)
        raise Killed

    with monkeypatch.context() as patched:
        patched.setattr(RunLock if before == "take" else RunFolder, before, kill)
        with pytest.raises(Killed):
            begin(OTHER, tmp_path / "run", source)
    killed[0].release()
    folder = begin(OTHER, tmp_path / "run", source)
    assert read_policy(folder.path, "0").header == OTHER.policy_header()
    assert format_starts(folder) == ("2 starts" if before in ("write_sizes", "reopen") else "1 start") + (
        f"; began with all of {source.path}, update {CheckpointFolder(source.checkpoints).numbers()[-1]}"
    )


@pytest.mark.parametrize("kept", ["notes.txt", "logs/x.log", "checkpoints/000000007/learner.pt", "checkpoints/x.pt"])
def test_a_folder_with_anything_else_is_left_alone(kept: str, source: RunFolder, tmp_path: Path) -> None:
    file = tmp_path / "run" / kept
    file.parent.mkdir(parents=True)
    file.write_text("of value")
    with pytest.raises(ConfigError, match="is there and is no run's folder"):
        begin(OTHER, tmp_path / "run", source)
    assert file.read_text() == "of value"


@pytest.mark.parametrize(
    ("config", "which", "message"),
    [
        (with_value(OTHER, "agent.hidden", 16), "", "that run has --hidden 8, this one has 16; use the same"),
        (with_value(OTHER, "agent.heads", (8, 9)), "", r"that run has --heads \(8, 8\), this one has \(8, 9\)"),
        (with_value(OTHER, "agent.grounding", False), "", "that run has --grounding True, this one has False"),
        (with_value(OTHER, "env.id", "Pendulum-v1"), "", "that run has 4 observations, this one has 3; use another"),
        (OTHER, ":7", r"use latest, best or one of \[\d+, "),
        (OTHER, "-none", "no such run; give the folder of a run, or RUN:CHECKPOINT"),
    ],
)
def test_what_does_not_fit_is_one_line_and_leaves_no_folder(
    config: RunConfig, which: str, message: str, source: RunFolder, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=rf"^--init-from='{source.path}{which}': .*{message}") as no:
        begin(config, tmp_path / "run", source, which=which)
    assert "\n" not in str(no.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("path", "value", "parts"), [("agent.gate_init", "chrono", "all"), ("agent.grounding", False, "policy")]
)
def test_what_makes_no_difference_to_the_parts_says_nothing(
    path: str, value: Any, parts: InitParts, source: RunFolder, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """How gates would have started; grounding, for a policy."""
    begin(with_value(OTHER, path, value), tmp_path / "run", source, parts)
    assert not caplog.records


def saved(value: Any) -> bytes:
    """As a state's file."""
    written = io.BytesIO()
    torch.save(value, written)
    return written.getvalue()


@pytest.mark.parametrize("state", [b"PK", saved([1]), saved({"agent": None})], ids=["cut", "a list", "no agent"])
def test_a_state_that_is_none_is_one_line(state: bytes, tmp_path: Path) -> None:
    copied = untrained(tmp_path / "copied", CONFIG)
    progress = json.dumps({"updates": 5, "env_steps": 50}).encode()
    CheckpointFolder(copied.checkpoints).save(5, {"learner.pt": state, "progress.json": progress})
    message = r"--init-from='.*copied': its checkpoint 5 cannot be used \(.+\); use another"
    with pytest.raises(ConfigError, match=message):
        begin(OTHER, tmp_path / "run", copied)
    assert not (tmp_path / "run").exists()


def test_by_the_command_line_the_first_evaluation_is_of_what_it_begins_with(
    source: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = "train InvertedPendulum-v5 --preset debug --hidden 8 --embedding 8 --heads 8 8 --normalize-observations"
    words += f" --policy-ema-updates 100 --total-steps 600 --launcher lockstep --init-from {source.path}"
    assert main.run([*words.split(), "--run-dir", str(tmp_path / "run")]) == 0
    capsys.readouterr()
    assert main.run(["evaluate", str(source.path), "--json"]) == 0
    played = json.loads(capsys.readouterr().out)
    initial = RunFolder(tmp_path / "run").initial()
    assert initial is not None
    assert initial["eval_return_mean"] == played["eval_return_mean"]
    assert main.run(["resume", str(tmp_path / "run"), "--init-parts", "policy"]) == 2
    assert "--init-parts" in capsys.readouterr().err
