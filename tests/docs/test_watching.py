"""The commands of docs/watching.md and docs/trackers.md run as they are printed."""

import json
import re
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args
from urllib.request import urlopen

import pytest

from rmc.analysis.run_list import DAMAGED
from rmc.deploy.run.state import State
from tests.command import COMMAND
from tests.docs.running import DOCS, LOCKSTEP, commands, ran
from tests.integration.running import free_port

WATCHING, TRACKERS = ((DOCS / f"{name}.md").read_text() for name in ("watching", "trackers"))
SHORT = (*LOCKSTEP, "--total-steps", "600")


def test_a_run_is_watched(tmp_path: Path) -> None:
    *looks, watch, served = commands(WATCHING)
    assert served[-2:] == ["--metrics-port", "9464"]
    port = str(free_port())  # another run may have the page's
    trained = ran(tmp_path, *served[:-1], port, *SHORT)
    assert f"metrics on 127.0.0.1, port {port}\n" in trained
    assert re.search(r"^\d+% \| \d+ of 600 steps \| .* updates/s \| eval .* \| 0:00:\d\d$", trained, re.MULTILINE)
    stats, as_json, listed = (ran(tmp_path, *words) for words in looks)
    assert "InvertedPendulum-v5 · debug · seed 0 · finished" in stats
    assert "600 of 600" in stats
    assert "latent rank" in stats
    assert json.loads(as_json)["state"] == "finished"
    assert re.search(r"^first +finished +600 .* 100%$", listed, re.MULTILINE)
    (one,) = json.loads(ran(tmp_path, "list", "runs", "--json"))
    assert (one["state"], one["env_steps"]) == ("finished", 600)
    with subprocess.Popen([*COMMAND, *watch, "--port", "0"], cwd=tmp_path, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        with urlopen(f"{server.stdout.readline().strip()}events", timeout=20) as events:
            state: dict[str, Any] = {}
            while state.get("state") != "finished":
                line = events.readline()
                state |= json.loads(line[6:]) if line.startswith(b"data: ") else {}
        server.send_signal(signal.SIGINT)
    assert server.returncode == 0
    assert {"updates_per_s", "model_loss"} <= state["curves"].keys()
    assert [role["kind"] for role in state["roles"] if role["count"]] == ["actor", "replay", "learner", "evaluator"]


def test_every_state_is_told() -> None:
    rows = re.findall(r"^\| `(\w+)` \| ", WATCHING.split("| state | says |")[1].split("\n\n")[0], re.MULTILINE)
    assert rows == [*get_args(State), DAMAGED]


@pytest.mark.timeout(300)
def test_runs_are_tracked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    for words in commands(TRACKERS):
        assert "no video" not in ran(tmp_path, *words, *SHORT)
    assert len(list(tmp_path.glob("runs/tracked/wandb/offline-run-*/*.wandb"))) == 1
    assert len(list(tmp_path.glob("runs/tracked/wandb/offline-run-*/files/media/videos/*.mp4"))) == 1
    assert results(tmp_path / "trackio" / "pendulum.db", "here-") == [600]
    (code,) = re.findall(r"```python\n(.*?)```", TRACKERS, re.DOTALL)
    assert code.count("train(config,") == 1
    code = f"import dataclasses\n{code}".replace("train(config,", "train(dataclasses.replace(config, total_steps=600),")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=150)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    assert results(tmp_path / "trackio" / "rmc.db", "python-") == [600]


def results(file: Path, name: str) -> list[int]:
    """The final environment steps of Trackio's runs of that name."""
    store = sqlite3.connect(file)
    rows = store.execute("select metrics from metrics where run_name like ?", (f"{name}%",)).fetchall()
    store.close()
    logged = [json.loads(metrics) for (metrics,) in rows]
    steps = [one["result/env_steps"] for one in logged if "result/env_steps" in one]
    assert sum("video" in one for one in logged) == len(steps)
    return steps
