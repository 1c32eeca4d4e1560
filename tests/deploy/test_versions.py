"""Runs of older versions, kept as they were made: read by every command, and gone on with, their ring included.

``runs/format-1-a`` was made before keywords of environments, sizes.json and initial.json; ``format-1-b`` by the last
version that wrote config.json without a format; ``format-2`` before rows had checksums and sensors dropped out;
``format-4``, with batch norm in its critics, before the policy could wait for its turn; ``format-5`` by the
last version with a LayerNorm behind the embedding; ``format-6`` before the target entropy was an option. All ended at
step 1500.
"""

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest

from rmc import load_policy
from rmc.analysis.history import of_run
from rmc.cli import main
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import to_json
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.migrations import FORMAT
from rmc.deploy.run.option_names import flat
from rmc.deploy.run.presets import debug, robust
from rmc.deploy.run.starts import starts
from rmc.replay_server.recovery import open_store
from tests.runs import read_config

RUNS = Path(__file__).parent / "runs"
# Whoever changes this list raises FORMAT by a migration, and keeps a run of the version before in runs/.
FORMAT_7 = """
    env.id env.flicker env.drop_sensors env.flicker_burst env.delay env.hide env.noise env.frame_stack
    env.action_repeat env.time_limit env.env_timeout env.env_kwargs preset seed total_steps actors
    window.burn_in window.trained_steps
    agent.hidden agent.embedding agent.heads agent.gate_init agent.head_input agent.critic_batch_norm
    agent.privileged_critic agent.normalize_observations agent.grounding agent.missing_flag agent.impute_missing
    agent.initial_priority
    actor.envs_per_actor actor.stride actor.state_strategy actor.reward_scale actor.refresh_steps actor.chunk_windows
    actor.chunk_seconds actor.unacked_bytes
    replay.capacity replay.replay_ratio replay.warmup_steps replay.priority_exponent replay.replay_shards
    update.learning_rate update.memory_learning_scale update.alpha_learning_rate update.target_entropy
    update.gamma update.polyak update.clip_norm update.latent_target update.target_memory update.policy_q
    update.curiosity update.curiosity_scale update.curiosity_steps update.scheme update.policy_through_q
    update.update_order update.model_norm update.policy_delay update.n_step update.eta update.policy_ema_updates
    learner.batch_size learner.importance_exponent learner.publish_updates learner.checkpoint_steps
    learner.keep_checkpoints learner.precision learner.threads evaluator.episodes evaluator.evaluation_seconds
""".split()  # noqa: SIM905


FORMATS = ("format-1-a", "format-1-b", "format-2", "format-3", "format-4", "format-5", "format-6")
BETWEEN = FORMATS[1:4]  # what brings the first up to date does so with these
the_rest_at_length = pytest.mark.parametrize(
    "old", [pytest.param(one, marks=[pytest.mark.long] * (one in BETWEEN)) for one in FORMATS], indirect=True
)


@pytest.fixture(params=FORMATS)
def old(request: pytest.FixtureRequest, tmp_path: Path) -> RunFolder:
    with tarfile.open(RUNS / f"{request.param}.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    return RunFolder(tmp_path / request.param)


def test_an_option_comes_with_a_format() -> None:
    assert sorted(flat(robust(EnvConfig("")))) == sorted(FORMAT_7)
    assert FORMAT == 7


def test_its_options_are_read_in_the_words_of_this_version(old: RunFolder) -> None:
    config, raw = old.config(), json.loads((old.path / "config.json").read_text())
    assert raw.get("format", 1) == int(old.path.name.split("-")[1])
    assert (config.agent.impute_missing, config.agent.missing_flag) == (True, True)
    average = "policy_ema_updates" if "format" in raw else "policy_average"
    assert config.update.policy_ema_updates == raw["update"][average] == 100
    assert (config.env.env_kwargs, config.env.drop_sensors) == ({}, 0.0)  # later options as if there were none
    assert (config.agent.privileged_critic, config.agent.gate_init) == (False, "uniform")
    cut = raw["evaluator"].get("evaluation_seconds", 0.0)  # without the option, no evaluation was cut
    assert config.evaluator.evaluation_seconds == cut
    assert read_config(to_json(config)) == config


def test_what_reads_reads_it(old: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    before = (old.path / "config.json").read_bytes()
    assert main.run(["evaluate", str(old.path), "--episodes", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["env_steps"] == 1_500
    assert main.run(["stats", str(old.path)]) == 0
    assert of_run(old).env_steps == 1_500
    policy = load_policy(old.path)
    observation, info = policy.make_env().reset(seed=0)
    assert policy.act(observation, info["missing"]).shape == (1,)
    assert (old.path / "config.json").read_bytes() == before


@the_rest_at_length
def test_what_exports_and_draws_reads_it(old: RunFolder) -> None:
    before = (old.path / "config.json").read_bytes()
    assert main.run(["export", str(old.path), "--out", str(old.path / "policy.safetensors")]) == 0
    assert main.run(["inspect", str(old.path), "--out", str(old.path / "inspect.png")]) == 0
    assert main.run(["plot", str(old.path), "--out", str(old.path / "curves.png")]) == 0
    assert (old.path / "config.json").read_bytes() == before


def test_its_ring_is_opened_whole(old: RunFolder) -> None:
    config = old.config()
    store = open_store(old.path / "replay", config.window_spec(), config.replay.capacity, 0.6)
    progress = store.ring.progress
    serials = np.arange(progress.valid_from, progress.next_serial)
    rows = np.zeros(80, store.ring.spec.dtype)
    assert store.ring.gather(serials % config.replay.capacity, rows).all()
    ratio = 0.0 if old.path.name.startswith("format-1") else 8.0
    assert (len(serials), progress.env_steps, progress.replay_ratio) == (80, 1_500, ratio)
    assert rows["serial"].tolist() == serials.tolist()
    missing = rows["missing"][..., 0]
    real = np.arange(missing.shape[1]) <= rows["last"][:, None]
    real &= np.arange(missing.shape[1]) >= rows["first"][:, None]
    assert 0.1 < missing[real].mean() < 0.3  # flicker 0.2
    assert np.count_nonzero(store.tree.values(np.arange(80))) == 80
    store.close()


@the_rest_at_length
def test_it_goes_on_with_ring_checkpoint_and_counters(old: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    config = old.config()
    store = open_store(old.path / "replay", config.window_spec(), config.replay.capacity, 0.6)
    before = store.ring.progress
    store.close()
    words = ["resume", str(old.path), "--total-steps", "1800", "--launcher", "lockstep", "--replay-ratio", "4"]
    assert main.run(words) == 0, capsys.readouterr().err
    raw = json.loads((old.path / "config.json").read_text())
    assert (raw["format"], raw["update"]["policy_ema_updates"], raw["total_steps"]) == (FORMAT, 100, 1_800)
    newest = CheckpointFolder(old.checkpoints).latest()
    assert newest is not None
    updates = json.loads(newest[1]["progress.json"])["updates"]
    store = open_store(old.path / "replay", old.config().window_spec(), 80, 0.6)
    now = store.ring.progress
    store.close()
    assert (now.env_steps >= 1_800, now.windows, now.draws) == (True, 80, updates)
    assert before.next_serial < now.next_serial < before.next_serial + 80  # the ring was not begun anew
    more = now.drawn_steps - before.drawn_steps
    assert before.draws < now.draws
    assert 300 * 4 - 16 * 15 <= more <= (now.env_steps - 1_500 + old.config().slack_steps()) * 4 + 16 * 15
    *_, start = starts(old)
    assert (start.env_steps, start.changes) == (
        1_500, {"total_steps": [1_500, 1_800], "replay.replay_ratio": [8.0, 4.0]}
    )  # fmt: skip


@pytest.mark.parametrize(
    ("format_", "message"),
    [(FORMAT + 1, f"newer version of RMC, this one reads up to {FORMAT}"), ("2", "a number from 1"), (0, "from 1")],
)
def test_a_format_that_is_none_of_ours_is_one_line(
    format_: object, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = json.loads(to_json(debug(EnvConfig("InvertedPendulum-v5")))) | {"format": format_, "surprise": 1}
    (tmp_path / "config.json").write_text(json.dumps(raw))
    for words in (["stats"], ["evaluate"], ["plot"], ["resume"], ["train", "--run-dir"]):
        assert main.run([*words, str(tmp_path)]) == 2
        line = capsys.readouterr().err
        assert message in line
        assert line.startswith(f"rmc: RUN='{tmp_path}': config.json format={format_!r}: ")
        assert line.count("\n") == 1


def test_an_option_that_this_format_does_not_know_is_refused() -> None:
    raw = json.loads(to_json(debug(EnvConfig("InvertedPendulum-v5"))))
    with pytest.raises(ConfigError, match=r"agent\.layer_norm=True: this version has no such option; use the version"):
        read_config(json.dumps(raw | {"format": 5, "agent": raw["agent"] | {"layer_norm": True}}))
    raw["agent"]["fill_blanks"] = True  # the old name, in a file that says it has the new ones
    with pytest.raises(ConfigError, match=r"agent\.fill_blanks=True: no such option"):
        read_config(json.dumps(raw))
