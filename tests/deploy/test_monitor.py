"""The launcher takes in whatever roles say, and goes on."""

import io
import json
import math
import random
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.event_multiplexer import EventMultiplexer
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from rmc.analysis import history
from rmc.common.bus import redis_connection
from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.bus.metrics_record import decode_record, encode_record
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.monitor import view
from rmc.deploy.monitor.main_metrics import evaluation_metrics
from rmc.deploy.monitor.monitor import Monitor
from rmc.deploy.monitor.plain_line import line
from rmc.deploy.monitor.run_status import MOST_NAMES, UNHEARD_SECONDS, RunStatus
from rmc.deploy.monitor.table import table
from rmc.deploy.monitor.view import terminal
from rmc.deploy.redis.server import RedisServer
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.metrics_tail import wall_seconds
from rmc.deploy.run.opening import open_run
from rmc.deploy.run.presets import debug
from tests.raising import raising
from tests.runs import untrained
from tests.waiting import wait_until

CONFIG = debug(EnvConfig("Pendulum-v1"))


@pytest.fixture
def config() -> RunConfig:
    return CONFIG


@pytest.fixture
def monitor(config: RunConfig, tmp_path: Path) -> Monitor:
    folder = untrained(tmp_path / "run", config)
    return Monitor(folder, config, Console(quiet=True, force_terminal=False))


@pytest.fixture
def frozen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock stands still: seconds in texts are exact."""
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now)


NUMBERS = [0, -1, 2**63 - 1, math.nan, math.inf, -math.inf, 1e300, 1.5]


NAMES = """
    env_steps updates eval_update broken_episodes time sample_age_mean latent_rank
    env_steps_per_s updates_per_s ring_fill replay_ratio busy_share waiting_share
    q_loss model_loss alpha beta curiosity_share model_unexplained policy_lag_mean
    episode_return_mean eval_return_mean eval_return_std eval_env_steps stale_state_stored stale_q_first_stored
    stale_state_burned stale_q_first_burned finished wall_s launcher
""".split()  # noqa: SIM905
ROLES = ("learner", "replay", "evaluator", "actor-0")


@pytest.mark.parametrize("value", NUMBERS)
def test_any_number_is_shown(monitor: Monitor, value: float) -> None:
    """All names that the view formats, each as a number that makes no sense."""
    bus = MemoryBus()
    for role in ROLES:
        bus.emit(role, {"waiting_for": "credit", **dict.fromkeys(NAMES, value)})
    monitor.watch(bus)
    shown = line(monitor.status)
    assert f" of {CONFIG.total_steps:,} steps | " in shown
    assert any(text in shown for text in ("credit", "silent")) == (value > 0.5)
    Console(quiet=True).print(table(monitor.status, 80))
    monitor.close()


@pytest.mark.parametrize(
    ("counter", "shown"),
    [(2**53, 2**53), (2**53 + 1, 2**53 + 1), (1e300, 2**63 - 1), (1.5, 1), (-1, 0), (math.nan, 0), (math.inf, 0)],
)
def test_steps_beyond_what_a_float_counts_are_shown(monitor: Monitor, counter: float, shown: int) -> None:
    monitor.take({"role": "replay", "env_steps": counter})
    monitor.take({"role": "learner", "checkpoint_update": 3, "checkpoint_env_steps": counter})
    assert monitor.status.env_steps == shown
    assert monitor.status.checkpoint_steps(3) == (shown or None)
    assert f"{shown:,} of " in line(monitor.status)
    monitor.close()


def test_names_are_shown_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And not taken for a console's markup, which would swallow or refuse them."""
    status = RunStatus("mine:[red]Env[/x]-v0", "debug", 0, 100, 32.0)
    terminal(200).print(table(status, 200), "run folder /runs/[words] :tada: [/]")
    shown = capsys.readouterr().out
    assert "mine:[red]Env[/x]-v0 · debug" in shown
    assert "/runs/[words] :tada: [/]" in shown


@pytest.mark.parametrize("seed", range(len(NAMES)))
def test_whatever_a_role_leaves_out_the_run_goes_on(monitor: Monitor, tmp_path: Path, seed: int) -> None:
    """One name alone, then any others beside it; and all that reads the run's folder later."""
    bus, chance = MemoryBus(), random.Random(seed)
    for count in (0, chance.randrange(len(NAMES))):
        for role in ROLES:
            record = {name: chance.choice(NUMBERS) for name in [NAMES[seed], *chance.sample(NAMES, count)]}
            bus.emit(role, decode_record(encode_record(record)))
        monitor.watch(bus)
        assert line(monitor.status)
        Console(quiet=True).print(table(monitor.status, 80))
    monitor.close()
    folder = RunFolder(tmp_path / "run")
    assert 0 <= wall_seconds(folder.metrics) < 60
    with suppress(ConfigError):  # where no evaluation was whole
        assert all(math.isfinite(one.return_mean) for one in history.of_run(folder).evaluations)


@pytest.mark.parametrize(
    "record", [{"eval_update": 3}, {"eval_return_mean": 1e9}, {"eval_update": 3, "eval_return_mean": math.inf}]
)
def test_half_of_an_evaluation_is_none(monitor: Monitor, record: dict[str, float]) -> None:
    monitor._checkpoints.save(3, {})
    monitor.take({"role": "evaluator", **record})
    assert monitor._checkpoints.best() is None
    monitor.take({"role": "evaluator", "eval_update": 3, "eval_return_mean": 1})
    assert monitor._checkpoints.best() == 3
    assert "1 at update 3" in shown(monitor.status)[0]
    monitor.close()


def test_each_role_speaks_for_itself_only(monitor: Monitor, tmp_path: Path) -> None:
    bus = MemoryBus()
    bus.emit("actor-0", {"role": 5, "updates": 7, "eval_update": 0, "eval_return_mean": 1e9})
    bus.emit("actor-9", {"updates": 8})  # the run has no such role
    monitor.watch(bus)
    monitor.close()
    lines = [json.loads(text) for text in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert {record["role"] for record in lines} == {"actor-0", "launcher"}
    assert monitor.status.get("learner", "updates") is None


class FloodedBus(MemoryBus):
    """One role says something new whenever it is read."""

    def records(self, after: Mapping[str, str]) -> tuple[list[dict[str, Any]], dict[str, str]]:
        self.emit("actor-0", {"time": 1.0})
        return super().records(after)


@pytest.mark.timeout(30)
def test_a_role_that_never_stops_talking_keeps_nobody(monitor: Monitor) -> None:
    monitor.watch(FloodedBus())
    monitor.close()


def test_an_evaluation_stands_where_its_checkpoint_was(monitor: Monitor, tmp_path: Path) -> None:
    def says(role: str, **metrics: float) -> None:
        bus.emit(role, {"time": 1.0, **metrics})
        monitor.watch(bus)

    bus = MemoryBus()
    says("replay", env_steps=1_300)
    says("evaluator", eval_update=3, eval_return_mean=1.0)  # of a checkpoint that the learner has not spoken of
    says("learner", checkpoint_update=4, checkpoint_env_steps=1_000)
    says("learner", checkpoint_update=8, checkpoint_env_steps=1_200)  # while 4 is still played
    says("evaluator", eval_update=4, eval_return_mean=2.0)
    monitor.close()
    lines = [json.loads(text) for text in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [one.get("eval_env_steps") for one in lines if one["role"] == "evaluator"] == [None, 1_000]
    events = EventAccumulator(str(tmp_path / "run")).Reload().Scalars("evaluator/eval_return_mean")
    assert [(event.step, event.value) for event in events] == [(1_300, 1.0), (1_000, 2.0)]


def test_tensorboard_has_the_main_metrics_and_the_options_under_the_runs_name(
    monitor: Monitor, tmp_path: Path, config: RunConfig
) -> None:
    bus, now = MemoryBus(), time.time()
    bus.emit("learner", {"time": now, "updates_per_s": 45.0, "q_loss": 0.5, "waiting_share": 0.25, "alpha": 0.1})
    bus.emit("actor-0", {"time": now, "waiting_share": 0.75, "episode_return_mean": 7.0})
    bus.emit("replay", {"time": now, "env_steps": 900, "env_steps_per_s": 95.0, "waiting_share": math.nan})
    bus.emit("evaluator", {"time": now, "eval_update": 3, "eval_return_mean": 12.0})
    monitor.watch(bus)
    monitor.close()
    shown = EventMultiplexer().AddRunsFromDirectory(str(tmp_path)).Reload()
    assert list(shown.Runs()) == ["run"]
    main = {tag: shown.Scalars("run", tag)[-1].value for tag in shown.GetAccumulator("run").Tags()["scalars"]}
    assert {tag.removeprefix("Main/"): value for tag, value in main.items() if tag.startswith("Main/")} == {
        "env_steps_per_s": 95.0, "updates_per_s": 45.0, "episode_return": 7.0, "evaluation_return": 12.0,
        "waiting_share_learner": 0.25, "waiting_share_actors": 0.75, "q_loss": 0.5,
    }  # fmt: skip
    assert min(main).startswith("Main/")  # as TensorBoard sorts
    content = shown.SummaryMetadata("run", "_hparams_/session_start_info").plugin_data.content
    hparams = HParamsPluginData.FromString(content).session_start_info.hparams
    assert hparams["update.gamma"].number_value == config.update.gamma
    assert hparams["env.id"].string_value == "Pendulum-v1"
    experiment = HParamsPluginData.FromString(shown.SummaryMetadata("run", "_hparams_/experiment").plugin_data.content)
    assert [one.name.tag for one in experiment.experiment.metric_infos] == ["Main/evaluation_return"]


def test_events_of_earlier_versions_join_the_runs_own(config: RunConfig, tmp_path: Path) -> None:
    folder = untrained(tmp_path / "run", config)
    (folder.path / "events").mkdir()
    (folder.path / "events" / "events.out.tfevents.1.host").write_bytes(b"")
    Monitor(folder, config, Console(quiet=True)).close()
    assert not list((folder.path / "events").iterdir())
    assert len(list(folder.path.glob("events.out.tfevents.*"))) == 2


def test_evaluations_of_earlier_starts_are_known(config: RunConfig, tmp_path: Path) -> None:
    folder = untrained(tmp_path / "run", config)
    scores = (3.0, 9.0, 5.0)
    evaluations = [{"role": "evaluator", "time": 1.0, "eval_return_mean": score, "eval_update": 3} for score in scores]
    folder.metrics.write_text("".join(json.dumps(record) + "\n" for record in evaluations))
    monitor = Monitor(folder, config, Console(quiet=True))
    assert "eval 5 (best 9)" in line(monitor.status)
    assert "evaluator" not in monitor.status.roles  # it has not spoken in this start
    monitor.close()


def test_an_evaluation_that_was_cut_is_never_the_best(monitor: Monitor, caplog: pytest.LogCaptureFixture) -> None:
    for update in (3, 6):
        monitor._checkpoints.save(update, {})
    whole_and_parts: list[dict[str, Any]] = [
        {"role": "evaluator", "eval_update": 3, "eval_return_mean": -900.0, "eval_cut": 0},
        {"role": "evaluator", "eval_update": 6, "eval_return_mean": -20.0, "eval_cut": 1},
        {"role": "evaluator", "eval_update": 6, "eval_return_mean": -10.0, "eval_broken_episodes": 4},
    ]
    for record in whole_and_parts:
        monitor.take(record)
    assert monitor._checkpoints.best() == 3
    assert monitor.status.best is not None
    assert monitor.status.last is not None
    assert (monitor.status.best.update, monitor.status.last.update) == (3, 6)
    assert "eval -10 (incomplete; best -900)" in line(monitor.status)
    assert [evaluation_metrics(one) == {} for one in whole_and_parts] == [False, True, True]
    monitor.take({"role": "evaluator", "eval_update": 9, "eval_return_mean": 50.0})  # still on the learner's node
    assert (monitor._checkpoints.best(), "dropped" in caplog.text) == (3, False)
    monitor._checkpoints.save(9, {})
    monitor.take({"role": "learner", "updates": 9})
    assert monitor._checkpoints.best() == 9
    monitor.take({"role": "evaluator", "eval_update": 1, "eval_return_mean": 0.0})
    assert "checkpoint 1 was dropped before its evaluation ended; raise --keep-checkpoints" in caplog.text
    monitor.close()


def test_the_clocks_of_other_machines_do_not_count(monitor: Monitor, monkeypatch: pytest.MonkeyPatch) -> None:
    bus, now = MemoryBus(), time.time()
    for second in range(12):
        monkeypatch.setattr(time, "time", lambda second=second: now + second)
        for role in ROLES:
            bus.emit(role, {"time": now - 3_600.0, "updates_per_s": 9.0})
        for shard in range(2):  # whose clocks differ, too
            bus.emit(f"replay-{shard}", {"time": now + second - 0.5 * shard, "env_steps": 50 * second})
        monitor.roles = lambda: (*ROLES, "replay-0", "replay-1")
        monitor.watch(bus)
    assert not monitor.status.silent()
    assert monitor.status.eta_s == pytest.approx((CONFIG.total_steps - 1_100) / 100.0, rel=0.1)
    monitor.close()


def test_a_redis_that_lost_its_newest_records_is_heard_and_what_it_kept_is_not_heard_again(
    monitor: Monitor, redis_url: str, run_name: str
) -> None:
    """By a snapshot; or by all of them, and the clock went back."""
    bus = RedisBus(redis_url, run_name)
    key = bus.key("metrics", "learner")
    bus.redis.xadd(key, {"r": encode_record({"updates": 3})}, id=f"{int(time.time() * 1_000) + 3_600_000}-0")
    monitor.watch(bus)
    assert monitor.status.get("learner", "updates") == 3
    bus.redis.delete(key)
    bus.emit("learner", {"updates": 2})
    for _ in range(2):  # the first look finds that out
        monitor._next_record = 0.0
        monitor.watch(bus)
    assert monitor.status.get("learner", "updates") == 3
    bus.emit("learner", {"updates": 5})
    monitor.watch(bus)
    assert monitor.status.get("learner", "updates") == 5
    monitor.close()


def test_new_names_without_end_are_left_out(monitor: Monitor) -> None:
    for start in range(0, 3 * MOST_NAMES, 100):
        monitor.status.take({"role": "actor-0", "env_steps": start, **{f"n{start + i}": 0 for i in range(100)}})
    assert len(monitor.status.roles["actor-0"]) <= MOST_NAMES
    assert monitor.status.get("actor-0", "env_steps") == 3 * MOST_NAMES - 100
    monitor.close()


def test_evaluations_that_found_no_room_are_marked_when_there_is_some(
    monitor: Monitor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    marked: list[tuple[int, float]] = []

    for update, score in ((10, 1.0), (20, 3.0), (30, 2.0)):
        monkeypatch.setattr(monitor._checkpoints, "mark_best", raising(OSError(28, "No space left on device")))
        monitor.take({"role": "evaluator", "eval_update": update, "eval_return_mean": score})
    monkeypatch.setattr(monitor._checkpoints, "mark_best", lambda *arguments: marked.append(arguments) or True)
    for _ in range(2):
        monitor.take({"role": "learner", "updates": 30})
    assert marked == [(10, 1.0), (20, 3.0), (30, 2.0)]
    monitor.close()


def shown(status: RunStatus) -> list[str]:
    """The view as a table, and as a line."""
    console = Console(file=io.StringIO(), width=200)
    console.print(table(status, 200))
    return [console.file.getvalue(), line(status)]  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("role", "metrics", "heading", "text"),
    [
        ("replay-0", {"damaged_windows": 8}, "damaged", "8 windows of the ring"),
        ("learner", {"damaged_checkpoints": 2}, "damaged", "2 newer checkpoints"),
        ("replay-1", {"replay_ratio": 39765.0, "replay_ratio_off": 1}, "replay ratio", "far from"),
        ("learner", {"checkpoint_error": "No space left on device"}, "not saved", "No space left on device"),
        ("launcher", {"not_running": "actor-3"}, "not running", "actor-3"),
        ("launcher", {"restarts": 3}, "restarts", "3 of roles"),
        ("actor-0", {"broken_episodes": 2}, "broken", "2 episodes"),
    ],
)
def test_what_is_not_as_it_should_be_is_shown(
    monitor: Monitor, role: str, metrics: dict[str, Any], heading: str, text: str
) -> None:
    for sound in (False, True):
        record = dict.fromkeys(metrics, type(next(iter(metrics.values())))()) if sound else metrics
        monitor.status.take({"role": role, **record})
        for text_of in shown(monitor.status):
            assert (heading in text_of and text in text_of) is not sound
    monitor.close()


def says(monitor: Monitor, ago: dict[str, float], **launcher: float) -> None:
    """Records of roles, each from so many seconds ago."""
    for role, seconds in ago.items():
        monitor.status.take(
            {"role": role, "time": time.time() - seconds, "waiting_share": 1.0, "waiting_for": "credit"}
        )
    monitor.status.take({"role": "launcher", "time": time.time(), "redis_away_s": 0.0, **launcher})


def test_a_run_that_goes_on_is_drawn_from_where_it_was(monitor: Monitor, config: RunConfig, tmp_path: Path) -> None:
    """Until its replay servers speak, too: curves would go back to step 0."""
    monitor.close()
    folder = RunFolder(tmp_path / "run")
    folder.history_file.write_text(json.dumps({"time": 1.0, "version": "0", "env_steps": 1_400}) + "\n")
    again = Monitor(folder, config, Console(quiet=True, force_terminal=False))
    assert "| 1,400 of " in line(again.status)
    again.watch(MemoryBus())
    again.take({"role": "replay", "time": time.time(), "env_steps": 1_500})
    again.close()
    steps = [event.step for event in EventAccumulator(str(folder.path)).Reload().Scalars("launcher/wall_s")]
    assert steps[-2:] == [1_400, 1_500]


@pytest.mark.usefixtures("frozen")
def test_every_view_says_who_is_silent_and_for_how_long(monitor: Monitor) -> None:
    says(monitor, {"learner": 12.2, "actor-0": 0.5, "replay": 4.0, "evaluator": 0.0})
    for text_of in shown(monitor.status):
        assert "learner for 12 s" in text_of
        assert "actor-0 for" not in text_of
    assert "waiting: actor-0 100% for credit, replay 100% for credit" in line(monitor.status)  # learner's is too old
    says(monitor, {"learner": 0.0})
    assert not any("silent" in text for text in shown(monitor.status))
    monitor.close()


@pytest.mark.usefixtures("frozen")
def test_a_redis_that_is_away_is_who_is_silent(monitor: Monitor) -> None:
    says(monitor, {"learner": 40.0, "actor-0": 41.0}, redis_away_s=38.0)
    for text_of in shown(monitor.status):
        assert "Redis for 38 s" in text_of
    assert "learner for" not in line(monitor.status)
    monitor.close()
    assert not any("silent" in text for text in shown(monitor.status))  # a run that is over


@pytest.mark.usefixtures("frozen")
def test_a_role_that_never_spoke_is_silent_once_it_should_have(
    monitor: Monitor, monkeypatch: pytest.MonkeyPatch
) -> None:
    says(monitor, {"learner": 0.0, "replay": 0.0, "evaluator": 0.0})
    assert "silent" not in line(monitor.status)
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 2 * UNHEARD_SECONDS)
    says(monitor, {"learner": 0.0, "replay": 0.0, "evaluator": 0.0})
    assert "silent: actor-0 for 60 s" in line(monitor.status)
    monitor.close()


def test_an_actor_that_an_earlier_start_had_is_not_silent(monitor: Monitor) -> None:
    """It has fewer now; what the last of them said does not count either."""
    monitor.status.take(
        {"role": "actor-1", "time": time.time() - 90.0, "episode_return_mean": 9.0, "broken_episodes": 2}
    )
    monitor.status.take({"role": "actor-0", "time": time.time(), "episode_return_mean": 1.0})
    says(monitor, {"learner": 0.0, "replay": 0.0, "evaluator": 0.0}, start_s=30.0)
    assert "silent" not in line(monitor.status)
    assert (monitor.status.episode_return, monitor.status.broken_episodes) == (1.0, 0)
    monitor.close()


@pytest.mark.usefixtures("frozen")
def test_many_that_are_silent_are_counted(monitor: Monitor) -> None:
    says(monitor, {f"actor-{index}": 20.0 for index in range(9)})
    assert "silent: actor-0 for 20 s, actor-1 for 20 s, actor-2 for 20 s and 6 more" in line(monitor.status)
    monitor.close()


def test_a_redis_that_stands_still_is_said_while_it_lasts_and_frames_go_on(
    config: RunConfig, short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(redis_connection, "TIMEOUT_SECONDS", 1.0)
    monkeypatch.setattr(view, "LINE_SECONDS", 0.1)
    monkeypatch.setattr(view, "REFRESH_SECONDS", 0.05)
    folder, printed = open_run(config, LaunchOptions(tmp_path / "run", "fail")), io.StringIO()
    folder.lock.release()
    with RedisServer(short) as server:
        bus, monitor = RedisBus(server.url(), "run"), Monitor(folder, config, Console(file=printed, width=500))
        assert server.process is not None
        for role in config.roles():
            bus.emit(role, {"time": time.time()})
        monitor.watch(bus)
        process = psutil.Process(server.process.pid)
        process.suspend()
        before = len(printed.getvalue().splitlines())
        monitor.watch(bus)  # waits for an answer
        assert len(printed.getvalue().splitlines()) >= before + 2
        wait_until(lambda: "silent: Redis for" in printed.getvalue().splitlines()[-1])
        process.resume()
        bus._rests_until = 0.0  # as once it has been left alone for as long as it took
        for role in config.roles():
            bus.emit(role, {"time": time.time()})
        monitor.watch(bus)
        wait_until(lambda: "silent" not in printed.getvalue().splitlines()[-1])
        monitor.close()
    away = [record["redis_away_s"] > 0 for record in folder.records() if "redis_away_s" in record]
    assert away == [False, True, False, False]  # each change is noted at once, for those who watch the file
