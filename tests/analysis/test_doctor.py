"""rmc doctor: what it makes of made-up records, and of real short runs that are held back on purpose."""

import dataclasses
import json
import math
import random
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from rmc.analysis import host_faults, run_faults
from rmc.analysis.bottleneck import bottleneck
from rmc.analysis.doctor import examine
from rmc.analysis.vitals import Vitals
from rmc.cli.main import run
from rmc.common.env.config import EnvConfig
from rmc.deploy.monitor.monitor import Monitor
from rmc.deploy.run.config import RunConfig, to_json
from rmc.deploy.run.presets import robust
from tests.command import rmc
from tests.runs import untrained

CONFIG = robust(EnvConfig("HalfCheetah-v5"))
Record = dict[str, Any]


def shares(busy: float, reason: str = "") -> Record:
    return {"busy_share": busy, "waiting_share": 1.0 - busy, "waiting_for": reason}


def records(seconds: int = 60, **roles: Record) -> list[Record]:
    """What roles say each second; a callable stands for a value of the second. ``actor_0`` is ``actor-0``."""
    roles = {"learner": {}, "actor_0": {}, "replay": {}, "launcher": {}} | roles
    return [
        {"role": role.replace("_", "-"), "time": 1000.0 + second}
        | ({"updates": 10 * second} if role == "learner" else {})
        | {name: value(second) if callable(value) else value for name, value in metrics.items()}
        for second in range(seconds)
        for role, metrics in roles.items()
    ]


def vitals(seconds: int = 60, **roles: Record) -> Vitals:
    return Vitals(records(seconds, **roles))


HOST = {"host_cores": 4, "host_cpus": 4, "host_load": 2.0, "host_idle_share": 0.5, "host_steal_share": 0.0}


def test_the_learner_holds_the_actors_back() -> None:
    finding = bottleneck(
        vitals(learner=shares(0.99), actor_0=shares(0.03, "credit"), replay=shares(0.2, "draws")), CONFIG
    )
    assert str(finding) == (
        "learner-bound: actors waited 97% of the time for credit, the learner was busy 99%; more actors will not help; "
        "a GPU (--device cuda) or a faster one, or --replay-ratio 48, would: "
        "the latter takes half the updates for each step, 2.0 times the steps a second"
    )


def test_the_actors_hold_the_learner_back() -> None:
    slow = {"learner": shares(0.5, "experience"), "actor_0": shares(0.97), "replay": shares(0.1, "windows")}
    finding = bottleneck(vitals(**slow, launcher=HOST), CONFIG)
    assert finding is not None
    assert (finding.name, finding.advice) == (
        "actor-bound",
        "--actors 2 would help; with what there is, --replay-ratio 192 would use the learner's idle time",
    )  # fmt: skip
    assert "learner waited 50%" in finding.measured
    full = bottleneck(vitals(**slow, launcher=HOST | {"host_idle_share": 0.02}), CONFIG)
    assert full is not None
    assert full.advice.startswith("all cores are taken: more machines (--launcher ray)")
    part = HOST | {"host_cpus": 64, "host_idle_share": 0.95}  # what is idle is not the run's
    for host in ({}, part):
        unknown = bottleneck(vitals(**slow, launcher=host), CONFIG)
        assert unknown is not None
        assert unknown.advice.startswith("more --actors would help where cores are free")


def test_the_replay_server_holds_both_back() -> None:
    finding = bottleneck(
        vitals(learner=shares(0.4, "experience"), actor_0=shares(0.3, "acknowledgements"), replay=shares(0.95)), CONFIG
    )
    assert finding is not None
    assert finding.name == "replay-bound"
    assert "--replay-shards 2 with --actors 2 in a new run, or" in finding.advice


def test_a_replay_server_that_is_busy_holds_no_learner_back_that_never_waits() -> None:
    finding = bottleneck(vitals(learner=shares(0.99), actor_0=shares(0.3, "credit"), replay=shares(0.95)), CONFIG)
    assert finding is not None
    assert finding.name == "learner-bound"


@pytest.mark.parametrize(
    ("learner", "actor", "name"),
    [
        (shares(0.5, "experience"), shares(0.3, "credit"), "delivery-bound"),
        (shares(0.95), shares(0.9, "credit"), "balanced"),
        (shares(0.5, "redis"), shares(0.3, "redis"), "redis-bound"),
    ],
)
def test_other_stages(learner: Record, actor: Record, name: str) -> None:
    finding = bottleneck(vitals(learner=learner, actor_0=actor, replay=shares(0.1, "windows")), CONFIG)
    assert finding is not None
    assert finding.name == name


def test_a_lockstep_run_has_one_clock_and_no_bottleneck() -> None:
    nothing = shares(0.0) | {"waiting_share": 0.0}
    assert bottleneck(vitals(learner=shares(1.0), actor_0=nothing, replay=nothing), CONFIG) is None


def test_a_wait_that_is_not_named_counts_for_the_usual_one() -> None:
    playing = vitals(actor_0=shares(0.2) | {"waiting_for": lambda second: "credit" if second % 2 else ""})
    assert playing.waits("actor") == {"credit": pytest.approx(0.8)}
    ends = vitals(actor_0=shares(0.2, "the end"))
    assert ends.busy("actor") is None


def test_only_the_newest_start_counts() -> None:
    before = [one | {"time": one["time"] - 10_000.0} for one in records(actor_0=shares(1.0))]
    assert Vitals([*before, *records(actor_0=shares(0.1, "credit"))]).busy("actor") == pytest.approx(0.1)


@pytest.mark.parametrize(("seconds", "pause"), [(90, 20.0), (2, 20.0), (90, 5.0)])
def test_a_resume_within_the_minute_is_another_start(seconds: int, pause: float) -> None:
    """What the start before said does not count: not the actors that it had more, nor that it came to its end."""
    before = records(seconds, learner={"finished": 1}, actor_1=shares(1.0), launcher={"start_s": lambda s: 0.1 + s})
    after = records(120, learner={"updates": 5}, replay={"env_steps": 7}, launcher={"start_s": lambda s: 0.2 + s})
    newest = Vitals([*before, *(one | {"time": one["time"] + seconds + pause} for one in after)])
    assert newest.roles == ["actor-0", "launcher", "learner", "replay"]
    assert run_faults.silent(newest, CONFIG) is None
    assert run_faults.stalled(newest, CONFIG) is not None


def test_of_a_long_start_only_the_newest_counts() -> None:
    """A stage that held the run back an hour ago does so no more."""
    assert (
        vitals(2_000, actor_0=shares(0.0) | {"busy_share": lambda second: float(second > 1_300)}).busy("actor") == 1.0
    )


def test_after_the_clock_was_set_back_the_newest_is_judged() -> None:
    said = records(2_000)
    said = [one | {"time": one["time"] + 9_000.0 - 3_600.0 * (one["time"] > 2_000.0)} for one in said]
    assert Vitals(said).last("learner", "updates") == 19_990


def test_a_deadlock_is_named_with_its_waits() -> None:
    still = records(
        120,
        learner=shares(0.0, "experience") | {"updates": lambda s: min(s, 20)},
        actor_0=shares(0.0, "credit"),
        replay=shares(0.0, "windows") | {"env_steps": lambda s: min(s, 30)},
    )
    (finding,) = examine(still, CONFIG)
    assert finding.name == "deadlock"
    assert finding.measured == (
        "no step and no update for 89 s (actor-0 for credit, learner for experience, replay for windows)"
    )
    still[-2]["finished"] = 1
    assert run_faults.stalled(Vitals([*still, {"role": "learner", "time": 1120.0, "finished": 1}]), CONFIG) is None
    assert run_faults.stalled(vitals(replay={"env_steps": lambda s: s}), CONFIG) is None


def test_a_disk_that_is_full_at_the_end_is_no_deadlock() -> None:
    full = records(
        120, learner=shares(0.0, "disk") | {"updates": 20, "waiting_s": float}, actor_0=shares(0.0, "the end"),
        replay=shares(0.0, "windows") | {"env_steps": 30},
    )  # fmt: skip
    assert [str(one) for one in examine(full, CONFIG)] == [
        "not saved: the learner has waited 119 s to write its last checkpoint; "
        "make room on the disk; do not stop the run"
    ]
    saved = Vitals([*full, {"role": "learner", "time": 1120.0, "finished": 1}])
    assert run_faults.not_saved(saved, CONFIG) is None


def test_a_role_that_fell_silent_is_named() -> None:
    finding = run_faults.silent(
        Vitals([one for one in records() if one["role"] != "actor-0" or one["time"] < 1010.0]), CONFIG
    )
    assert (
        str(finding) == "silent: actor-0 for 50 s said nothing; it hangs, or its machine is away; see logs/actor-0.log"
    )
    assert run_faults.silent(vitals(), CONFIG) is None


@pytest.mark.parametrize("role", ["actor-0", "learner"])
def test_it_is_named_however_long_it_is_silent(role: str) -> None:
    since = [one for one in records(900) if one["role"] != role or one["time"] < 1010.0]
    assert f"silent: {role} for 890 s said nothing" in "\n".join(map(str, examine(since, CONFIG)))


def test_a_warm_up_that_takes_long_is_told() -> None:
    metrics: Record = {"learner": {"updates": 0}, "replay": {"env_steps": 1_000, "env_steps_per_s": 10.0}}
    finding = run_faults.long_warm_up(vitals(**metrics), CONFIG)
    assert finding is not None
    assert "1,000 of 5,000 steps at 10 a second, 400 s to go" in finding.measured
    assert "--warmup-steps 1250 in a new run, or" in finding.advice
    metrics["replay"]["env_steps_per_s"] = 100.0
    assert run_faults.long_warm_up(vitals(**metrics), CONFIG) is None


def test_an_evaluator_that_cannot_keep_up() -> None:
    checkpoints = {"checkpoint_update": lambda s: s // 10 * 100}
    starving = vitals(learner=checkpoints, evaluator={"eval_update": lambda s: s // 30 * 300})
    finding = run_faults.evaluator_starved(starving, CONFIG)
    assert finding is not None
    assert finding.measured == "4 of 5 checkpoints were not evaluated"
    assert finding.advice.startswith("--checkpoint-steps 50000 gives it the time, --episodes 1")
    sound = vitals(learner=checkpoints, evaluator={"eval_update": lambda s: max(0, s // 10 * 100 - 100)})
    assert run_faults.evaluator_starved(sound, CONFIG) is None
    resumed = vitals(40, learner={"checkpoint_update": lambda s: 500 + s // 15 * 100}, evaluator={"eval_update": 600})
    assert run_faults.evaluator_starved(resumed, CONFIG) is None  # the start before has played the first
    none = dataclasses.replace(CONFIG, evaluator=dataclasses.replace(CONFIG.evaluator, episodes=0))
    assert run_faults.evaluator_starved(starving, none) is None


def test_while_redis_is_away_nobody_is_blamed() -> None:
    """The launcher alone is heard, and says for how long."""
    spoken = records(30)
    away = [{"role": "launcher", "time": 1030.0 + second, "redis_away_s": float(second)} for second in range(90)]
    (finding,) = examine([*spoken, *away], CONFIG)
    assert str(finding) == "redis away: no answer for 89 s; every role waits for it; look at its server"
    assert "redis away" not in {one.name for one in examine(spoken, CONFIG)}


def test_stale_weights_name_the_option_that_ages_them() -> None:
    old = vitals(replay={"policy_lag_mean": 4_000.0, "drawn_steps": 480.0, "draws": 2.0})
    refresh = dataclasses.replace(CONFIG, actor=dataclasses.replace(CONFIG.actor, refresh_steps=20_000))
    finding = run_faults.stale_weights(old, refresh)
    assert str(finding) == (
        "stale weights: windows came from a policy 4,000 updates old on average; "
        "--refresh-steps 2500 in place of 20000 brings newer ones"
    )
    publish = dataclasses.replace(CONFIG, learner=dataclasses.replace(CONFIG.learner, publish_updates=8_000))
    finding = run_faults.stale_weights(old, publish)
    assert finding is not None
    assert finding.advice.startswith("--publish-updates 1000 ")
    assert run_faults.stale_weights(vitals(replay={"policy_lag_mean": 160.0}), CONFIG) is None


def test_critics_that_expect_what_no_rewards_can_give() -> None:
    learner = {"largest_reward": 4.0, "alpha": 0.1, "entropy": -6.0, "q_mean": 5_000.0}
    finding = run_faults.diverging(vitals(learner=learner), CONFIG)
    assert str(finding) == (
        "critics diverge: they expect 5,000; rewards of 4 and the entropy's bonus make 460 at most; "
        "--learning-rate, a third of it, in a new run"
    )
    for sound in ({"q_mean": 450.0}, {"q_mean": -450.0}, {"largest_reward": 0.0}):
        assert run_faults.diverging(vitals(learner=learner | sound), CONFIG) is None
    curious = dataclasses.replace(CONFIG, update=dataclasses.replace(CONFIG.update, curiosity=0.5))
    assert run_faults.diverging(vitals(learner=learner), curious) is None  # its reward is not on record


def test_a_ring_that_never_fills() -> None:
    short = dataclasses.replace(CONFIG, total_steps=100_000)
    little = vitals(replay={"env_steps": 50_000, "ring_fill": 0.05})
    finding = run_faults.oversized_ring(little, short)
    assert str(finding) == (
        "ring never fills: of 70,000 windows 10% will be used at the end of the run; "
        "--capacity 7800 in a new run holds all of it"
    )
    assert run_faults.oversized_ring(little, CONFIG) is None  # a million steps fill it
    lost_a_ring = vitals(replay={"env_steps": 50_000, "windows": 20_000, "ring_fill": 0.01})
    assert run_faults.oversized_ring(lost_a_ring, short) is None


def test_threads_that_fight() -> None:
    greedy = dataclasses.replace(CONFIG, learner=dataclasses.replace(CONFIG.learner, threads=8))
    finding = host_faults.threads_fight(vitals(launcher=HOST), greedy)
    assert (
        str(finding) == "threads fight: the learner has 8 threads on 4 cores; --threads 3 leaves one to the other roles"
    )
    full = HOST | {"host_idle_share": 0.01}
    learner = shares(1.0) | {"threads": 3}
    busy = {"learner": learner, "actor_0": shares(0.9), "actor_1": shares(0.9), "replay": shares(0.5)}
    finding = host_faults.threads_fight(vitals(launcher=full, **busy), CONFIG)
    assert finding is not None
    assert finding.measured == "5.3 threads of the run are busy at a time, on 4 cores"
    assert finding.advice == "--threads 1 in place of 3 would fit"
    assert host_faults.threads_fight(vitals(launcher=HOST, **busy), CONFIG) is None  # they sleep: half is idle


def test_a_machine_that_others_use() -> None:
    finding = host_faults.oversubscribed(vitals(launcher=HOST | {"host_load": 9.0}, learner=shares(0.5)), CONFIG)
    assert finding is not None
    assert finding.measured == "load 9.0 on 4 CPUs, of which this run is 1.0"
    assert host_faults.oversubscribed(vitals(launcher=HOST), CONFIG) is None
    for cores in (0, -3):  # as a damaged record may have it
        odd = vitals(launcher=HOST | {"host_load": 9.0, "host_cores": cores}, learner=shares(0.5))
        assert host_faults.oversubscribed(odd, CONFIG) is None
    stolen = host_faults.stolen(vitals(launcher=HOST | {"host_steal_share": 0.25}), CONFIG)
    assert stolen is not None
    assert "25% of the CPU time" in stolen.measured


def test_memory_that_is_slow() -> None:
    copied = {"host_copy_bytes_per_s": lambda s: 12e9 if s < 10 else 3e9}
    finding = host_faults.slow_memory(vitals(launcher=copied), CONFIG)
    assert finding is not None
    assert finding.measured == "it was copied at 3.0 GB/s, at best at 12.0 GB/s"
    steady = {"host_copy_bytes_per_s": lambda s: 12e9 if s < 10 else 6e9}
    assert host_faults.slow_memory(vitals(launcher=steady), CONFIG) is None


def test_memory_that_is_short() -> None:
    memory = {"host_memory_bytes": 16e9, "host_available_bytes": 8e9, "host_swap_bytes": 0.0}
    assert host_faults.little_memory(vitals(launcher=memory), CONFIG) is None
    finding = host_faults.little_memory(vitals(launcher=memory | {"host_available_bytes": 4e8}), CONFIG)
    assert finding is not None
    assert finding.measured == "400 of 16,000 MB were free, 0 MB were swapped"
    swaps = host_faults.little_memory(vitals(launcher=memory | {"host_swap_bytes": lambda s: 2e6 * s}), CONFIG)
    assert swaps is not None
    assert "118 MB were swapped" in swaps.measured


def test_records_without_host_figures_are_judged_as_far_as_they_go() -> None:
    findings = examine(records(learner=shares(0.99), actor_0=shares(0.03, "credit")), CONFIG)
    assert [one.name for one in findings] == ["learner-bound"]


def recorded_run(path: Path, lines: list[Record], config: RunConfig = CONFIG) -> Path:
    path.mkdir()
    (path / "config.json").write_text(to_json(config))
    (path / "metrics.jsonl").write_text("".join(f"{json.dumps(one)}\n" for one in lines))
    return path


def test_a_run_that_has_just_begun_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, lines in {"silent": [], "short": records(4)}.items():
        path = recorded_run(tmp_path / name, lines)
        assert run(["doctor", str(path)]) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert err.startswith(f"rmc: RUN='{path}': it has ")
        assert "the doctor needs 5; train it for longer" in err
        assert err.count("\n") == 1


def trained(folder: Path, *words: str) -> str:
    """What a real run prints, whose doctor afterwards says the same."""
    done = rmc("train", *words, "--preset", "debug", "--run-dir", str(folder), timeout=170)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    asked = rmc("doctor", str(folder), timeout=60)
    assert (asked.returncode, asked.stderr) == (0, "")
    *findings, last = asked.stdout.splitlines()
    assert last.startswith("judged by the newest ")
    assert done.stdout.splitlines()[-len(findings) :] == findings
    assert findings
    return asked.stdout


@pytest.mark.long
def test_a_real_run_that_its_learner_holds_back(tmp_path: Path) -> None:
    assert "learner-bound: actors waited " in trained(tmp_path / "run", "InvertedPendulum-v5", "--replay-ratio", "64")


@pytest.mark.long
def test_a_real_run_that_its_environment_holds_back(tmp_path: Path) -> None:
    output = trained(tmp_path / "run", "tests.slow_env:Slow-v0", "--total-steps", "1500")
    assert "actor-bound: the learner waited " in output


@pytest.mark.long
def test_a_real_run_whose_evaluator_starves(tmp_path: Path) -> None:
    words = "--total-steps 1800 --replay-ratio 4 --warmup-steps 200 --checkpoint-steps 100 --episodes 20".split()  # noqa: SIM905
    output = trained(tmp_path / "run", "tests.slow_env:Slow-v0", *words)
    assert "evaluator starved: " in output


def test_a_run_records_its_host(tmp_path: Path) -> None:
    folder = untrained(tmp_path / "run")
    Monitor(folder, folder.config(), Console(quiet=True)).close()
    (last,) = folder.records()
    assert 0 < last["host_available_bytes"] <= last["host_memory_bytes"]
    assert 1 <= last["host_cores"] <= last["host_cpus"]
    assert all(0.0 <= last[name] <= 1.0 for name in ("host_idle_share", "host_steal_share"))
    assert last["host_load"] >= 0.0
    assert last["host_copy_bytes_per_s"] > 1e6


def test_whatever_roles_say_the_doctor_does_not_fail() -> None:
    """It ends every run, and roles are not trusted."""
    numbers = [0, -1, 2**63 - 1, math.nan, math.inf, -math.inf, 1e300, 0.5]
    names = """
        time updates env_steps env_steps_per_s busy_share waiting_share policy_lag_mean ring_fill eval_update finished
        checkpoint_update host_cores host_cpus host_load host_idle_share host_steal_share host_copy_bytes_per_s
        host_memory_bytes host_available_bytes host_swap_bytes
    """.split()  # noqa: SIM905
    chance = random.Random(0)
    for _ in range(300):
        lines = records(30, learner=shares(0.5, "experience"), actor_0=shares(0.9), replay=shares(0.4), launcher=HOST)
        for record in chance.sample(lines, 40):
            record[chance.choice(names)] = chance.choice(numbers)
        examine(lines, CONFIG)


def test_a_role_that_pauses_for_a_minute_does_not_begin_another_start() -> None:
    said = records(120, learner=shares(0.99), actor_0=shares(0.03, "credit"))
    said = [one for one in said if one["role"] != "actor-0" or not 1020 < one["time"] < 1090]
    training = Vitals(said).training()
    assert training.roles == ["actor-0", "launcher", "learner", "replay"]
    assert training.busy("learner") == pytest.approx(0.99)
    assert training.seconds > 100.0
