"""What a run looks like while it goes: on terminals of any size, in a pipe, with and without colour."""

import io
import time
from typing import Any

import pytest
from rich.console import Console

from rmc.deploy.monitor import run_status
from rmc.deploy.monitor.notices import notices, waits
from rmc.deploy.monitor.plain_line import line
from rmc.deploy.monitor.run_status import RunStatus
from rmc.deploy.monitor.table import table

WIDTHS = (40, 80, 120, 250)
SECONDS = 40  # that the status's history lasts
RATE = 95  # environment steps a second


def full_status(actors: int = 2, start: float = 0.0) -> RunStatus:
    """A run at 120 000 of a million steps, with two evaluations; its records begin at a start's second."""
    status, now = RunStatus("HalfCheetah-v5", "robust", 1, 1_000_000, 32.0), time.time()
    for ago in range(SECONDS, -1, -1):
        at = {"time": now - ago}
        status.take({"role": "launcher", **at, "wall_s": 1270.0 - ago, "start_s": start + SECONDS - ago})
        status.take(
            {"role": "learner", **at, "updates": 45_123, "updates_per_s": 45.2, "q_loss": 0.3, "busy_share": 1.0}
        )
        status.take({"role": "learner", **at, "latent_rank": 31.0, "alpha": 0.1, "curiosity_share": 0.02})
        steps = {"env_steps": 120_000 - ago * RATE, "env_steps_per_s": float(RATE)}
        status.take({"role": "replay", **at, **steps, "waiting_share": 0.8, "waiting_for": "draws"})
    for index in range(actors):
        waits = {"waiting_share": 0.9, "waiting_for": "credit", "busy_share": 0.1}
        status.take({"role": f"actor-{index}", "time": now, **waits, "episode_return_mean": 3_900.0})
    for score, at_step in ((4_402.0, 100_000), (4_310.2, 118_000)):
        record = {"eval_return_mean": score, "eval_return_std": 120.5, "eval_update": 40_000, "eval_env_steps": at_step}
        status.take({"role": "evaluator", "time": now, **record})
    return status


def drawn(of: RunStatus, width: int, height: int | None, **console: bool) -> list[str]:
    file = io.StringIO()
    Console(file=file, width=width, **console).print(table(of, width, height))  # type: ignore[arg-type]
    return file.getvalue().splitlines()


@pytest.mark.parametrize("actors", [1, 32, 300])
@pytest.mark.parametrize("trouble", [False, True])
@pytest.mark.parametrize("height", [14, 40, None])
@pytest.mark.parametrize("width", WIDTHS)
def test_what_matters_is_there_at_every_size(
    width: int, height: int | None, trouble: bool, actors: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In 15 rows, too, of which the cursor takes one."""
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now)
    of = full_status(actors)
    if trouble:
        of.take({"role": "learner", "time": now, "checkpoint_error": "No space left on device"})
        of.take({"role": "launcher", "time": now, "wall_s": 1270.0, "start_s": SECONDS, "restarts": 3})
        of.take({"role": "actor-0", "time": now - 20})
    rows = drawn(of, width, height)
    assert height is None or len(rows) <= height
    assert max(map(len, rows)) <= width
    text = " ".join(" ".join(row.split()) for row in rows)
    for shown in (
        "robust · seed 1 · training",
        "12.0%",
        "120,000 of 1,000,000, 95 /s",
        "0:21:10, ETA 2:34:",
        "45.2 /s",
    ):
        assert shown in text
    for shown in ("4,310 ± 120 at", "118,000", "4,402 ± 120 at", "100,000", "draws"):
        assert shown in text
    assert ("credit" in text) is not (trouble and actors == 1)
    for shown in ("No space left on device", "3 of roles that died", "actor-0 for 20 s"):
        assert (shown in text) is trouble


@pytest.mark.parametrize("width", WIDTHS)
def test_details_fill_the_room_that_is_left(width: int) -> None:
    assert "latent rank" not in " ".join(drawn(full_status(), min(width, 80), 14))
    assert "latent rank" in " ".join(drawn(full_status(), width, 40))


def test_many_actors_share_a_row_where_rows_are_few() -> None:
    assert any("32 actors" in row and "90%" in row for row in drawn(full_status(32), 80, 14))
    assert any("actor-31" in row for row in drawn(full_status(32), 80, None))


def test_a_terminal_has_colour_unless_it_asks_for_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    cyan, escape = "\x1b[36m", "\x1b"
    assert cyan in "".join(drawn(full_status(), 80, 14, force_terminal=True))
    assert escape not in "".join(drawn(full_status(), 80, 14, force_terminal=False))
    monkeypatch.setenv("NO_COLOR", "1")
    assert cyan not in "".join(drawn(full_status(), 80, 14, force_terminal=True))


def test_the_plain_line_says_how_far_it_is_and_who_waits() -> None:
    text = line(full_status(4))
    assert text.startswith("12% | 120,000 of 1,000,000 steps | 45 updates/s | eval 4,310 (best 4,402) | 0:21:10, ETA ")
    assert text.endswith(" | waiting: 4 actors 90% for credit, replay 80% for draws")
    assert line(RunStatus("Env-v0", "debug", 0, 100, 1.0)) == "0% | 0 of 100 steps | – updates/s | eval – | –, ETA –"


def test_the_end_is_told_from_the_last_minute_of_this_start() -> None:
    of = full_status()
    assert of.eta_s == pytest.approx(880_000 / RATE)
    resumed, now = full_status(start=100.0), time.time()
    resumed.take({"role": "launcher", "time": now, "wall_s": 1270.0, "start_s": 0.0})
    assert resumed.eta_s is None  # of another start nothing is taken over
    for second in range(12):
        resumed.take({"role": "replay", "time": now + second, "env_steps": 120_000 + 10 * second})
    assert resumed.eta_s == pytest.approx((880_000 - 110) / 10)


def test_no_end_is_told_before_the_learner_learns_or_while_no_steps_come() -> None:
    of, now = RunStatus("Env-v0", "debug", 0, 100_000, 1.0), time.time()
    for second in range(30):
        of.take({"role": "replay", "time": now + second, "env_steps": 100 * second})  # of the warm-up
    assert of.eta_s is None
    of.take({"role": "learner", "time": now, "updates_per_s": 5.0})
    for second in range(30, 60):
        of.take({"role": "replay", "time": now + second, "env_steps": 3_000})
    assert of.eta_s is None


def test_no_end_is_told_while_redis_is_away() -> None:
    of = full_status()
    assert of.eta_s is not None
    said = {"role": "launcher", "time": time.time(), "start_s": of.get("launcher", "start_s")}
    of.take(said | {"redis_away_s": 600.0})
    assert of.eta_s is None
    of.take(said | {"redis_away_s": 0.0})
    assert of.eta_s is not None


def test_what_roles_of_an_earlier_start_said_is_no_rate_of_this_one() -> None:
    of, now = RunStatus("Env-v0", "debug", 0, 1_000, 1.0), time.time()
    for shard in ("replay-0", "replay-1"):
        of.take({"role": shard, "time": now - 500.0, "env_steps": 70, "env_steps_per_s": 100.0})
    of.take({"role": "launcher", "time": now, "start_s": 0.0})
    assert of.replay("env_steps_per_s", sum) is None
    of.take({"role": "replay-0", "time": now, "env_steps": 71, "env_steps_per_s": 9.0})
    assert (of.replay("env_steps_per_s", sum), of.env_steps) == (9.0, 141)  # what is counted goes on


def test_a_baselines_end_is_told_from_its_learner() -> None:
    of, now = RunStatus("Env-v0", "sac", 0, 10_000, 1.0), time.time()
    of.heard = "launcher"
    for second in range(20):
        of.take({"role": "launcher", "time": now + second, "wall_s": float(second)})
        of.take({"role": "learner", "time": now + second, "env_steps": 40 * second, "updates": 40 * second})
    assert of.eta_s == pytest.approx((10_000 - 760) / 40.0)


def test_episodes_that_break_in_an_evaluation_are_told_too() -> None:
    of = full_status()
    before = of.broken_episodes
    of.take({"role": "evaluator", "time": time.time(), "eval_broken_episodes": 3, "eval_update": 9})
    assert of.broken_episodes == before + 3


def waiting_status(seconds: int, **learner: Any) -> RunStatus:
    """All wait, and no counter has moved for so long."""
    of, now = RunStatus("Env-v0", "debug", 0, 100_000, 1.0), time.time()
    of.take({"role": "learner", "time": now - seconds - 1, "updates": 39, "waiting_share": 0.0, "waiting_for": ""})
    waits: dict[str, dict[str, Any]] = {"replay": {"env_steps": 7}, "actor-0": {}, "learner": {"updates": 40}}
    for ago in range(seconds, -1, -1):
        for role, counts in waits.items():
            said = {"waiting_share": 1.0, "waiting_for": "the other", **counts}
            of.take({"role": role, "time": now - ago, **said, **(learner if role == "learner" else {})})
    return of


def test_a_run_in_which_all_wait_and_nothing_moves_is_said_to_hang() -> None:
    assert notices(waiting_status(65))["deadlock"] == "no step and no update for 65 s, see rmc doctor"
    assert "deadlock" in line(waiting_status(65))
    for of in (
        waiting_status(55),
        waiting_status(65, waiting_share=0.2),  # it works
        waiting_status(65, waiting_for="disk"),  # which is said elsewhere
    ):
        assert "deadlock" not in notices(of)
    resumed = waiting_status(65)  # an hour later it goes on, with the counters of before
    for second in range(40):
        resumed.take({"role": "learner", "time": time.time() + 3_600 + second, "updates": 40, "waiting_share": 1.0})
    assert resumed.stalled_s < 45
    moving = waiting_status(65)
    moving.take({"role": "replay", "time": time.time(), "env_steps": 8})
    assert "deadlock" not in notices(moving)


def test_the_time_goes_on_until_the_run_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    of, now = full_status(), time.time()
    monkeypatch.setattr(run_status.time, "time", lambda: now + 100)
    assert of.elapsed_s == pytest.approx(1370, abs=2)
    of.state = "finished"
    assert of.elapsed_s == 1270
    assert "ETA" not in line(of)
    assert "finished" in drawn(of, 80, None)[0]


def test_the_pause_between_two_starts_is_no_time_trained(monkeypatch: pytest.MonkeyPatch) -> None:
    of, now = full_status(), time.time()
    of.began = now + 90
    monkeypatch.setattr(run_status.time, "time", lambda: now + 100)
    assert of.elapsed_s == pytest.approx(1270, abs=2)


def test_who_was_there_in_an_earlier_start_alone_is_not_shown() -> None:
    of, now = full_status(actors=4), time.time()
    of.take({"role": "launcher", "time": now + 1_000, "wall_s": 1271.0, "start_s": 1.0})
    of.take({"role": "actor-0", "time": now + 1_000, "waiting_share": 0.9, "waiting_for": "credit"})
    assert waits(of) == "actor-0 90% for credit"
    shown = "\n".join(drawn(of, 80, None))
    assert "actor-0" in shown
    assert "actor-3" not in shown
