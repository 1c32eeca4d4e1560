"""rmc train --dry-run: its figures beside a real run's, and its marks where a machine has too little."""

import dataclasses
import os
import re
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from rich.filesize import decimal as size_text

from rmc.analysis.needs import Need, There, needs, speed
from rmc.cli import dry_run as cli_dry_run
from rmc.cli import main
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.common.process.role import StopSignal
from rmc.deploy.local import trial
from rmc.deploy.local.trial import RoleUse, Trial, trial_config
from rmc.deploy.monitor.figures import duration
from rmc.deploy.run.host import Machine, this_machine
from rmc.deploy.run.preflight import ring_bytes
from rmc.deploy.run.presets import debug, robust
from rmc.replay_server.ring import file_bytes
from tests.command import COMMAND, rmc
from tests.deploy.test_config import with_value
from tests.integration.running import Training
from tests.runs import untrained
from tests.waiting import wait_until

CONFIG = debug(EnvConfig("InvertedPendulum-v5"))
MACHINE = Machine(4, 8 << 30, 100 << 30, 1024, 10e9)
TRAIN = ["train", "InvertedPendulum-v5", "--preset", "debug"]
MEMORY_TOLERANCE = 0.3  # of a role's: when a process is looked at decides on some of it
DISK_TOLERANCE = 0.05


def records() -> list[dict[str, Any]]:
    """Ten seconds in which 80 batches of 16 windows of 15 steps are drawn: 600 environment steps at a ratio of 32."""
    messages = []
    for second in range(12):
        of_replay = {"drawn_steps": 1920.0 * second, "windows": 5 * second, "env_steps": 60 * second}
        messages.append({"role": "replay", "time": 100.0 + second, "busy_share": 0.5, "waiting_share": 0.5} | of_replay)
        of_learner = {"updates": 8 * second, "threads": 3, "busy_share": 1.0, "waiting_share": 0.0}
        messages.append({"role": "learner", "time": 100.5 + second} | of_learner)
    return messages


MEASURED = Trial({"learner": RoleUse(300 << 20, 20, 4)}, records(), 2_000_000, 1_000.0)


def rows(config=CONFIG, machine: Machine = MACHINE, **uses: RoleUse) -> dict[str, Need]:
    roles = {"learner": RoleUse(300 << 20, 20, 4), "actor-0": RoleUse(50 << 20, 10, 2)} | uses
    return {row.what: row for row in needs(config, Trial(roles, records(), 2_000_000, 1_000.0), machine)}


def test_the_speed_is_that_at_which_the_ratio_holds() -> None:
    measured = speed(CONFIG, records())
    assert measured.steps_per_s == pytest.approx(1920.0 / 32.0)
    assert measured.updates_per_s == pytest.approx(8.0)
    assert measured.windows_per_s == pytest.approx(5.0)
    with pytest.raises(ConfigError, match="--total-steps=4000: a trial of it is over too soon"):
        speed(CONFIG, [])


def test_a_warm_up_says_nothing_of_the_speed() -> None:
    before: list[dict[str, Any]] = [{"role": "learner", "time": 80.0 + second, "updates": 0} for second in range(20)]
    before += [{"role": "replay", "time": 80.0 + second, "drawn_steps": 0.0} for second in range(20)]
    before.sort(key=lambda one: one["time"])
    assert speed(CONFIG, [*before, *records()]).steps_per_s == pytest.approx(60.0)


def test_each_need_stands_beside_what_there_is() -> None:
    table = rows(**{"actor-1": RoleUse(50 << 20, 10, 2)})
    row = CONFIG.window_spec().dtype.itemsize
    assert table["memory, actor (2)"].needs == size_text(100 << 20)
    assert table["memory, all"].needs == size_text((400 << 20) + file_bytes(CONFIG.window_spec(), 2_000))
    assert table["memory, all"].has == "8.6 GB free"
    assert table["disk, 5 checkpoints"].needs == "10.0 MB"
    assert table["bandwidth to replay"].needs == f"{size_text(5 * row)}/s"
    assert table["bandwidth from replay"].needs == f"{size_text(8 * 16 * row)}/s"
    assert table["file handles of a role"].needs == "20 (learner)"
    assert table["threads"].needs == "3 learner + 3 others, 3.5 busy"  # the learner's, and half of the replay server
    assert table["time to the end"].needs == "0:01:06 at 60 steps/s, 8.0 updates/s"
    assert all(one.fits is not False for one in table.values())


@pytest.mark.parametrize(
    ("less", "what", "is_needed"),
    [
        ({"free_memory_bytes": 100 << 20}, ["memory, all"], True),
        ({"free_disk_bytes": 260 << 20}, ["disk, all"], True),
        ({"handles": 19}, ["file handles of a role"], True),
        ({"cores": 2}, ["threads"], False),
        ({"copied_bytes_per_s": 1e4}, ["bandwidth to replay", "bandwidth from replay"], False),
    ],
)
def test_what_does_not_fit_is_marked(less: dict[str, Any], what: list[str], is_needed: bool) -> None:
    config = dataclasses.replace(CONFIG, learner=dataclasses.replace(CONFIG.learner, threads=3))
    table = rows(config, dataclasses.replace(MACHINE, **less))
    assert [(row.what, row.is_needed) for row in table.values() if row.fits is False] == [
        (one, is_needed) for one in what
    ]


def test_a_short_run_keeps_no_more_checkpoints_than_it_makes() -> None:
    short = dataclasses.replace(CONFIG, total_steps=CONFIG.learner.checkpoint_steps)
    assert rows(short)["disk, 2 checkpoints"].needs == "4.0 MB"


def test_a_run_that_goes_on_needs_what_is_to_come() -> None:
    tried, ring = Trial({"learner": RoleUse(1, 1, 1)}, records(), 1_000_000, 0.0), ring_bytes(CONFIG)
    before, after = (
        {row.what: row.needs for row in needs(CONFIG, tried, MACHINE, there)}
        for there in (There(), There(ring, 3_000_000, 1_000))
    )
    assert (before["disk, ring"], after["disk, ring"]) == (size_text(ring), size_text(0))
    assert [rows["disk, 5 checkpoints"] for rows in (before, after)] == ["5.0 MB", "2.0 MB"]
    assert [rows["time to the end"].split(" at")[0] for rows in (before, after)] == [
        duration(CONFIG.total_steps / 60), duration((CONFIG.total_steps - 1_000) / 60)
    ]  # fmt: skip


def test_a_trial_keeps_all_but_its_ring_and_warm_up() -> None:
    config = robust(EnvConfig("HalfCheetah-v5"))
    shorter = trial_config(config)
    assert (shorter.replay.capacity, shorter.replay.warmup_steps) == (1_000, 16 * 15)
    assert dataclasses.replace(shorter, replay=config.replay) == config


def test_this_machine_has_something(tmp_path: Path) -> None:
    machine = this_machine(tmp_path / "not" / "there")
    assert min(dataclasses.astuple(machine)) > 0


def dry_run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return rmc(*TRAIN, "--dry-run", "--run-dir", str(folder), *words, timeout=170)


def bytes_of(output: str, what: str) -> float:
    match = re.search(rf"^{re.escape(what)} +([\d.,]+) (kB|MB|GB)", output, re.MULTILINE)
    assert match, output
    return float(match[1].replace(",", "")) * {"kB": 1e3, "MB": 1e6, "GB": 1e9}[match[2]]


def seen_memory(run: Training) -> dict[str, int]:
    """The most that each kind of process of a real run holds, until it ends."""
    most: dict[str, int] = {}
    while run.process.poll() is None:
        try:
            for process in [run.launcher, *run.launcher.children(recursive=True)]:
                words = process.cmdline()
                kind = next((one for one in ("learner", "replay", "actor", "evaluator") if one in words), "other")
                most[kind] = max(most.get(kind, 0), process.memory_full_info().pss)
        except psutil.Error:
            continue
        time.sleep(0.1)
    return most


@pytest.mark.long
@pytest.mark.timeout(400)
def test_estimates_are_what_a_real_run_takes(tmp_path: Path) -> None:
    output = dry_run(tmp_path / "planned")
    assert (output.returncode, output.stderr) == (0, ""), output.stdout + output.stderr
    assert output.stdout.splitlines()[-1] == "it fits"
    assert not (tmp_path / "planned").exists()
    with Training(tmp_path / "real") as run:
        held = seen_memory(run)
        assert run.process.returncode == 0, run.text()
    for role in ("learner", "replay", "actor", "evaluator"):
        assert bytes_of(output.stdout, f"memory, {role}") == pytest.approx(held[role], rel=MEMORY_TOLERANCE), role
    ring = (tmp_path / "real" / "replay" / "ring").stat().st_size
    assert bytes_of(output.stdout, "disk, ring") == pytest.approx(ring, rel=DISK_TOLERANCE)
    kept = [file for file in (tmp_path / "real" / "checkpoints").rglob("*") if file.is_file()]
    each = sum(file.stat().st_size for file in kept) / len(list((tmp_path / "real" / "checkpoints").glob("0*")))
    assert bytes_of(output.stdout, "disk, 5 checkpoints") / 5 == pytest.approx(each, rel=DISK_TOLERANCE)


def test_a_ring_that_is_too_large_is_marked_and_the_status_is_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """That of docs/doctor.md is real."""
    monkeypatch.setattr(cli_dry_run, "run_trial", lambda config, device, stop: MEASURED)
    words = [*TRAIN, "--dry-run", "--run-dir", str(tmp_path / "run"), "--capacity", "1000000000000"]
    assert main.run(words) == 1
    output, errors = capsys.readouterr()
    assert errors == ""
    assert re.search(r"^memory, all .* DOES NOT FIT$", output, re.MULTILINE)
    assert output.splitlines()[-1] == "does not fit: memory, all, disk, all"
    assert not (tmp_path / "run").exists()


def test_a_run_that_goes_on_is_tried_with_what_a_new_one_has_no_use_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli_dry_run, "run_trial", lambda config, device, stop: MEASURED)
    folder = untrained(tmp_path / "run", CONFIG)
    folder.write_config(with_value(CONFIG, "env.flicker_burst", 5.0))
    assert main.run(["resume", str(folder.path), "--dry-run"]) == 0
    output, errors = capsys.readouterr()
    assert (errors, output.splitlines()[-1]) == ("", "it fits")
    monkeypatch.setattr(trial, "_train", lambda *_: MEASURED.roles)
    assert trial.run_trial(folder.config(), "cpu", StopSignal()).roles == MEASURED.roles


def test_a_folder_of_something_else_is_refused_as_a_start_would(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis.tex").write_text("")
    assert main.run([*TRAIN, "--dry-run", "--run-dir", str(tmp_path)]) == 2
    assert capsys.readouterr() == (
        "",
        f"rmc: --run-dir='{tmp_path}': is there and is no run's folder; give another one\n",
    )


def test_a_trial_needs_processes(tmp_path: Path) -> None:
    output = dry_run(tmp_path / "run", "--launcher", "lockstep")
    assert (output.returncode, output.stdout) == (2, "")
    assert output.stderr == "rmc: --dry-run=True: a trial needs --launcher local, not lockstep\n"


def test_ctrl_c_leaves_nothing(tmp_path: Path) -> None:
    words = [*COMMAND, *TRAIN, "--dry-run", "--run-dir", str(tmp_path / "run")]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    process = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        wait_until(lambda: list(tmp_path.glob("rmc-trial-*/run/metrics.jsonl")), 60.0)
        process.send_signal(signal.SIGINT)
        _, output = process.communicate(timeout=60.0)
    finally:
        process.kill()
    assert (process.returncode, output) == (130, "")
    assert not list(tmp_path.glob("r*"))  # torch keeps a cache of its own
