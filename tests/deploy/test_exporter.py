"""What Prometheus is shown, to how many at once, and when its alerts fire; tests/integration has a real scrape."""

import dataclasses
import json
import math
import re
import shutil
import socket
import subprocess
import threading
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from rmc.cli import main, role_commands
from rmc.deploy.local.role_command import launcher_command
from rmc.deploy.monitor import exporter
from rmc.deploy.monitor.run_status import RunStatus
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.starts import note_start
from tests.integration.running import free_port
from tests.raising import raising

ROOT = Path(__file__).parents[2]
ALERTS = ROOT / "deploy" / "monitor" / "alerts.yaml"
DOCS = (ROOT / "docs" / "watching.md").read_text()
HERE = "127.0.0.1"
promtool = pytest.mark.skipif(shutil.which("promtool") is None, reason="no promtool here: apt-get install prometheus")
STOPS, RISES = "0+50x5 250x75", "0+50x80"  # a value each minute
ANOTHER_RUN = {'rmc_run_info{run="a"}': "1x10 stale", 'rmc_run_info{run="b"}': "_x10 1x30"}
CASES = [  # an alert, what it looks at, and in which minutes it is silent and fires
    ("RmcGone", {"up": "1x10 0x40", 'rmc_run_info{run="a"}': "1x10 stale"}, [10, 40], [14, 20]),
    ("RmcGone", {"up": "0x40"}, [5, 20], []),  # that never served a run
    ("RmcNothingLearnt", {'rmc_updates{role="learner"}': STOPS}, [12], [16, 40]),
    ("RmcNothingLearnt", {'rmc_updates{role="learner"}': "0x40"}, [8], [12]),  # a warm-up
    ("RmcNothingLearnt", {'rmc_updates{role="learner"}': RISES}, [2, 12, 40], []),
    ("RmcNothingLearnt", {'rmc_updates{role="learner"}': "0+60x25 stale"}, [24, 30, 35, 40], []),  # a run's end
    ("RmcRoleSilent", {'rmc_silent_seconds{role="actor-0"}': "0x3 30 90x2 0x3"}, [2, 4, 8], [5, 6]),
    ("RmcRingLost", {'rmc_ring_windows{role="replay"}': "0+100x10 1000x10 20+20x30"}, [5, 20, 48], [22, 30, 45]),
    (
        "RmcRingLost",  # another run on the same port
        {'rmc_ring_windows{role="replay"}': "1000x10 20+20x30", **ANOTHER_RUN}, [12, 20, 30, 38], [],
    ),
    (
        "RmcRingLost", {'rmc_ring_windows{role="replay"}': "1000x20 20+20x30", 'rmc_run_info{run="a"}': "1x50"},
        [20, 48], [22, 30, 43],
    ),
    ("RmcWeightsStale", {'rmc_weights_update{role="actor-0"}': STOPS, "rmc_updates": RISES}, [16, 62], [66]),
    ("RmcWeightsStale", {'rmc_weights_update{role="actor-0"}': STOPS, "rmc_updates": STOPS}, [16, 66], []),
    ("RmcWeightsStale", {'rmc_weights_update{role="actor-0"}': RISES, "rmc_updates": RISES}, [12, 70], []),
    ("RmcDiskNearlyFull", {"rmc_host_disk_free_bytes": "10e9x5 1e9x9", "rmc_host_disk_bytes": "99e9x15"}, [5], [8]),
]  # fmt: skip


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def status() -> RunStatus:
    status, now = RunStatus("Pendulum-v1", "debug", 3, 4_000, 32.0, ("actor-0", "learner")), time.time()
    status.take({"role": "actor-0", "time": now - 20.0, "busy_share": 0.25, "weights_update": 40, "refused_weights": 2})
    status.take({"role": "learner", "time": now, "updates": 60, "updates_per_s": math.nan, 'a"}\\': 1})
    replay = {"env_steps": 700, "ring_windows": 30, "ring_capacity": 90, "dead_letters": 5, "dead_letters_crc": 4}
    status.take({"role": "replay", "time": now, **replay, 'dead_letters_"}\\ 1': 1, "refused_clients": 0})
    status.take({"role": "evaluator", "time": now, "eval_return_mean": -9.5, "eval_update": 40})
    status.take({"role": "launcher", "time": now, "restarts": 2, "restarts_actor-0": 2, "restarts_learner": 0})
    return status


def scraped(port: int) -> str:
    with urllib.request.urlopen(f"http://{HERE}:{port}/metrics", timeout=10) as answer:
        return str(answer.read().decode())


def test_every_role_is_shown(status: RunStatus, port: int) -> None:
    with exporter.served(status, "first", LaunchOptions(None, metrics_port=port)):
        for _ in range(2 * exporter.MOST_CLIENTS):
            text = scraped(port)
    families = list(text_string_to_metric_families(text))
    shown = {(one.name, *one.labels.values()): one.value for family in families for one in family.samples}
    silent = shown.pop(("rmc_silent_seconds", "actor-0"))
    assert silent == pytest.approx(20.0, abs=5.0)
    assert shown == {
        ("rmc_run_info", "Pendulum-v1", "debug", "first", "3"): 1, ("rmc_total_steps",): 4_000,
        ("rmc_evaluation_return",): -9.5, ("rmc_evaluation_return_best",): -9.5,
        **{("rmc_silent_seconds", role): 0 for role in ("learner", "replay", "evaluator", "launcher")},
        ("rmc_busy_share", "actor-0"): 0.25, ("rmc_weights_update", "actor-0"): 40, ("rmc_updates", "learner"): 60,
        ("rmc_env_steps", "replay"): 700, ("rmc_ring_windows", "replay"): 30,
        ("rmc_ring_capacity_windows", "replay"): 90,
        ("rmc_restarts_total", "actor-0"): 2, ("rmc_restarts_total", "learner"): 0,
        ("rmc_refusals_total", "", "actor-0", "weights"): 2,
        ("rmc_refusals_total", "crc", "replay", "entries"): 4, ("rmc_refusals_total", "", "replay", "clients"): 0,
        ("rmc_refusals_total", '"}\\ 1', "replay", "entries"): 1,
    }  # fmt: skip
    assert {family.name for family in families} == {name.removesuffix("_total") for name in documented()}


def documented() -> set[str]:
    """The metrics in a table of docs/watching.md."""
    table = re.split(r"^\| metric \|.*\n", DOCS, flags=re.MULTILINE)[1].partition("\n\n")[0]
    return {name for row in table.splitlines() for name in re.findall(r"`(\w+)`", row.split("|")[1])}


def test_every_alert_is_tried() -> None:
    (group,) = yaml.safe_load(ALERTS.read_text())["groups"]
    assert {rule["alert"] for rule in group["rules"]} == {alert for alert, *_ in CASES}


def test_strangers_take_few_handles_and_the_end_waits_for_none(
    status: RunStatus, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exporter._Handler, "timeout", 60.0)
    with exporter.served(status, "first", LaunchOptions(None, metrics_port=port)):
        strangers = [socket.create_connection((HERE, port), timeout=10) for _ in range(exporter.MOST_CLIENTS)]
        with socket.create_connection((HERE, port), timeout=10) as one_more:
            assert one_more.recv(1) == b""
        began = time.monotonic()
    assert time.monotonic() - began < 20.0
    for stranger in strangers:
        stranger.close()


def test_where_no_thread_can_be_started_later_looks_are_answered(
    status: RunStatus, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    with exporter.served(status, "first", LaunchOptions(None, metrics_port=port)):
        with monkeypatch.context() as patch:
            patch.setattr(threading.Thread, "start", raising(RuntimeError("can't start new thread")))
            for _ in range(2 * exporter.MOST_CLIENTS):
                with socket.create_connection((HERE, port), timeout=10) as client:
                    assert client.recv(1) == b""
        assert "rmc_updates" in scraped(port)


def test_a_port_that_is_taken_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server((HERE, 0)) as taken:
        port = taken.getsockname()[1]
        words = ["train", "Pendulum-v1", "--preset", "debug", "--run-dir", str(tmp_path / "run")]
        assert main.run([*words, "--metrics-port", str(port)]) == 2
    assert capsys.readouterr().err == f"rmc: --metrics-port={port}: Address already in use on {HERE}; take another\n"
    assert not list(tmp_path.iterdir())


def test_a_second_start_is_not_told_of_the_port_that_the_first_one_has(
    folder: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server((HERE, 0)) as taken:
        port = taken.getsockname()[1]
        folder.lock.take()
        words = ["resume", str(folder.path), "--metrics-port", str(port)]
        assert main.run(words) == 2
        folder.lock.release()
    fault = "this run is being trained; stop it first, or look at it: rmc stats"
    assert capsys.readouterr().err == f"rmc: --run-dir='{folder.path}': {fault}\n"


def test_nobodys_name_is_looked_up(status: RunStatus, port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no DNS answers that takes as long as its patience."""
    monkeypatch.setattr(socket, "getfqdn", lambda *_: pytest.fail("it was"))
    with exporter.served(status, "first", LaunchOptions(None, metrics_port=port, metrics_host="0.0.0.0")):
        assert "rmc_" in scraped(port)


@pytest.mark.parametrize(
    "options",
    [{}, {"device": "cuda", "all_cpus": True, "tls": True, "metrics_port": 9464, "metrics_host": "0.0.0.0"}],
)
def test_a_launcher_on_ray_has_the_options_of_the_newest_start(
    folder: RunFolder, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    had: list[LaunchOptions] = []

    def conduct(_: object, folder: RunFolder, options: LaunchOptions, *__: object) -> int:
        had.append(options)
        folder.lock.release()
        return 0

    monkeypatch.setattr(role_commands.training, "conduct", conduct)
    monkeypatch.setattr(role_commands.signals, "interrupt", lambda: None)
    started = LaunchOptions(folder.path, launcher="ray", **options)
    note_start(folder, {}, dataclasses.replace(started, device="cpu", metrics_port=1), None)
    note_start(folder, {}, started, None)
    assert main.run(list(launcher_command(str(folder.path), "head:1").words)) == 0
    assert had == [dataclasses.replace(started, ray_address="head:1")]


@promtool
def test_the_names_are_as_prometheus_wants_them(status: RunStatus, port: int) -> None:
    with exporter.served(status, "first", LaunchOptions(None, metrics_port=port)):
        text = scraped(port)
    done = subprocess.run(["promtool", "check", "metrics"], input=text, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@promtool
def test_alerts_fire_when_they_should(tmp_path: Path) -> None:
    tests = []
    for alert, series, quiet, firing in CASES:
        expr = f'count(ALERTS{{alertname="{alert}", alertstate="firing"}})'
        expected = [(minute, []) for minute in quiet] + [(minute, [{"labels": "{}", "value": 1}]) for minute in firing]
        tests.append({
            "interval": "1m",
            "input_series": [{"series": name, "values": values} for name, values in series.items()],
            "promql_expr_test": [{"expr": expr, "eval_time": f"{at}m", "exp_samples": there} for at, there in expected],
        })  # fmt: skip
    file = tmp_path / "tests.yaml"
    file.write_text(json.dumps({"rule_files": [str(ALERTS)], "evaluation_interval": "1m", "tests": tests}))
    done = subprocess.run(["promtool", "test", "rules", file], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
