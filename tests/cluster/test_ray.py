"""Runs on Ray without ssh: one of its own, and several nodes as raylets of this machine."""

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import ray
from ray.cluster_utils import Cluster

from rmc.deploy.run.folder import RunFolder
from tests.cluster import machines
from tests.command import rmc
from tests.deploy.test_tls import lacks_tls
from tests.integration.running import ENVIRONMENT, Training, free_port
from tests.processes import matching
from tests.waiting import wait_until

JOINS = """
import os, signal, time
from rmc.deploy.ray import launcher

init = launcher.ray.init

def signalled(**options):
    init(**options)
    os.kill(os.getpid(), signal.SIGTERM)

launcher.ray.init = signalled
try:
    with launcher.joined("local", 1):
        pass
except KeyboardInterrupt:
    print("interrupted")
time.sleep(4.0)
print("saved")
"""
ENDLESS = ("--total-steps", "10000000", "--replay-ratio", "8")


@pytest.fixture(autouse=True)
def leaves_nothing_behind() -> Iterator[None]:
    """Ray keeps a few files of its own for later; no process may stay but those of another Ray on this machine."""
    before = _running()
    yield
    wait_until(lambda: not _running() - before, said=lambda: _running() - before)


def _running() -> set[psutil.Process]:
    ours = rf"raylet/raylet|gcs_server|rmc\.cli\.main.*{re.escape(tempfile.gettempdir())}"
    return set(matching(ours, psutil.process_iter()))


def _pids(words: str) -> list[int]:
    return [one.pid for one in matching(re.escape(words), psutil.process_iter())]


def ring(folder: Path) -> Path:
    """Where the replay server's node keeps it."""
    return Path(tempfile.gettempdir()) / f"rmc-ray-{os.getuid()}-{RunFolder(folder).identity()}" / "replay" / "ring"


def test_a_run_on_a_ray_of_its_own(tmp_path: Path) -> None:
    folder, port = tmp_path / "run", free_port()
    options = ("--launcher", "ray", "--ray-address", "local", "--metrics-port", str(port), "--total-steps", "2000")
    with Training(folder, *options) as training:
        training.wait_for_updates()
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
            assert b'rmc_updates{role="learner"}' in answer.read()
        assert ring(folder).exists()
        assert training.finish(240) == 0, training.text() + training.logs()
    result = json.loads((folder / "result.json").read_text())
    assert not ring(folder).exists()  # the run is over
    assert result["env_steps"] == 2_000
    assert result["updates"] > 100
    assert result["restarts"] == 0
    assert "after training:" in training.text()
    for role in ("actor-0", "replay", "learner", "evaluator", "launcher"):
        assert training.records(role), role
    assert (folder / "checkpoints" / "best.json").exists()
    assert {path.name for path in (folder / "logs").iterdir()} >= {"launcher.log", "learner.log", "replay.log"}


def test_sigterm_while_ray_is_joined_leaves_a_process_that_can_save() -> None:
    """Ray's own handler would end it by SIGABRT after three seconds."""
    done = subprocess.run([sys.executable, "-c", JOINS], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "interrupted\nsaved\n"), done.stderr


@pytest.mark.long
def test_two_shards_speak_over_the_network_and_encrypted_where_redis_can(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    options = ["--replay-shards", "2", "--actors", "2", "--total-steps", "2000", *([] if lacks_tls() else ["--tls"])]
    with Training(folder, *options, "--launcher", "ray", "--ray-address", "local") as training:
        training.wait_for_updates(1)
        secret = RunFolder(folder).secret().decode()
        commands = [" ".join(process.info["cmdline"] or []) for process in psutil.process_iter(["cmdline"])]
        assert any("--listen tcp:" in words for words in commands)
        assert not any(secret in words for words in commands)
        assert training.finish(240) == 0, training.text() + training.logs()
    assert json.loads((folder / "result.json").read_text())["env_steps"] == 2_000
    for role in ("replay-0", "replay-1"):
        assert training.newest(role, "refused_clients", None) == 0
        assert training.newest(role, "drawn_steps") > 0


@pytest.mark.long
def test_checkpoints_that_do_not_reach_the_head_are_said_and_brought_later(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    launcher_log = folder.logs / "launcher.log"
    with Training(folder.path, *ENDLESS, "--launcher", "ray", "--ray-address", "local") as training:
        training.wait_for_updates(1)
        folder.checkpoints.rename(tmp_path / "aside")
        folder.checkpoints.write_text("in the way")
        training.wait_for(lambda: "learner: checkpoints do not reach the head" in launcher_log.read_text())
        folder.checkpoints.unlink()
        (tmp_path / "aside").rename(folder.checkpoints)
        training.wait_for(lambda: "learner: checkpoints reach the head again" in launcher_log.read_text())
        training.interrupt()
    (folder.checkpoints / "epoch").write_text("7")  # of a learner of which nobody remembers anything else
    with Training(folder.path, *ENDLESS, "--launcher", "ray", "--ray-address", "local") as training:
        training.wait_for(lambda: (folder.checkpoints / "epoch").read_text() == "8")
        training.interrupt()


@pytest.fixture
def nodes(request: pytest.FixtureRequest) -> Iterator[Cluster]:
    """A head with room for all but the actors, unless the test says other CPUs."""
    os.environ["RAY_AUTH_MODE"] = "disabled"  # cluster_utils makes no token
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": getattr(request, "param", 2), "include_dashboard": False}
    )
    try:
        yield cluster
    finally:
        ray.shutdown()
        cluster.shutdown()
        del os.environ["RAY_AUTH_MODE"]


@pytest.mark.skipif(not machines.missing(), reason="make test-cluster does that here, on machines")
def test_a_node_is_lost_and_another_comes(nodes: Cluster, tmp_path: Path) -> None:
    first, _ = nodes.add_node(num_cpus=1), nodes.add_node(num_cpus=1)
    folder = tmp_path / "run"
    os.environ["RAY_AUTH_MODE"] = "disabled"
    with Training(folder, *ENDLESS, "--launcher", "ray", "--ray-address", nodes.address, "--actors", "2") as training:
        training.wait_for_updates(50)
        training.wait_for(lambda: all(training.newest(f"actor-{k}", "env_steps") > 0 for k in range(2)))

        nodes.remove_node(first, allow_graceful=False)
        training.wait_for(lambda: len(training.newest("launcher", "not_running", "").split()) == 1)
        lost = training.newest("launcher", "not_running")
        training.wait_for_updates(100)  # the other goes on

        nodes.add_node(num_cpus=1)
        began = time.monotonic()
        before = len(training.records(lost))
        training.wait_for(lambda: len(training.records(lost)) > before + 2)
        assert time.monotonic() - began < 30.0
        training.wait_for(lambda: training.newest("launcher", "not_running", "") == "")
        training.wait_for_updates(100)
        steps = [record["env_steps"] for record in training.records("replay")]
        assert steps == sorted(steps)
        assert [training.newest("replay", name, None) for name in ("entry_gaps", "dead_letters")] == [0, 0]

        trainer = RunFolder(folder).lock.trainer()
        assert trainer is not None
        done = rmc("stop", str(folder), env=ENVIRONMENT)
        assert done.returncode == 0, done.stderr
        assert "to go on:\n  rmc resume " in done.stdout
        assert training.finish(60) == 130
    assert max(RunFolder(folder).checkpoints.glob("[0-9]*")).is_dir()


@pytest.mark.long
def test_a_killed_launcher_and_a_role_that_somebody_ended_come_back(nodes: Cluster, tmp_path: Path) -> None:
    nodes.add_node(num_cpus=1)
    folder = RunFolder(tmp_path / "run")
    with Training(folder.path, *ENDLESS, "--launcher", "ray", "--ray-address", nodes.address) as training:
        training.wait_for_updates(50)
        before = folder.lock.trainer()
        assert before is not None
        os.kill(before, signal.SIGKILL)
        training.wait_for(lambda: folder.lock.trainer() not in (None, before))
        steps = training.newest("replay", "env_steps")
        training.wait_for(lambda: training.newest("replay", "env_steps") > steps + 200)
        training.wait_for_updates(100)
        (replay,) = _pids(f"rmc.cli.main role replay --run={folder.name}")
        os.kill(replay, signal.SIGTERM)  # it ends cleanly, though nobody wants the run to end
        training.wait_for(lambda: _pids(f"rmc.cli.main role replay --run={folder.name}") not in ([], [replay]))
        training.wait_for_updates(100)
        again = folder.lock.trainer()
        assert again is not None
        os.kill(again, signal.SIGKILL)
        training.wait_for(lambda: folder.lock.trainer() not in (None, again))
        updates = training.newest("learner", "updates")
        training.interrupt()  # the new launcher has heard of no role yet
    assert training.process.returncode == 130
    assert max(int(path.name) for path in folder.checkpoints.glob("[0-9]*")) >= updates
    assert ring(folder.path).exists()  # it may go on from there


@pytest.mark.long
@pytest.mark.timeout(400)
@pytest.mark.parametrize("nodes", [0], indirect=True)
def test_freed_cpus_go_to_the_learner_that_lost_its_node(nodes: Cluster, tmp_path: Path) -> None:
    """Though another run's actors wait for them. Both runs are listed and stopped by their names."""
    for host in (2, 3):
        nodes.add_node(num_cpus=2, node_ip_address=f"127.0.0.{host}")
    on_ray = ("--launcher", "ray", "--ray-address", nodes.address)
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
    with Training(tmp_path / "a" / "run", *ENDLESS, *on_ray, "--actors", "2") as one:
        one.wait_for_updates(50)  # its learner has one node, its two actors have the other
        nodes.add_node(num_cpus=3, node_ip_address="127.0.0.4")
        with Training(tmp_path / "b" / "run", *ENDLESS, *on_ray, "--actors", "3") as other:
            other.wait_for_updates(50)
            assert other.newest("launcher", "not_running") == "actor-1 actor-2"

            before = _learner_node(one)
            lost = next(node for node in nodes.worker_nodes if node.node_ip_address in before)
            gone = time.time()
            nodes.remove_node(lost, allow_graceful=False)
            one.wait_for(lambda: _learner_node(one) not in ([], before))
            one.wait_for(lambda: one.newest("learner", "time") > gone + 5.0)
            nodes.add_node(num_cpus=4, node_ip_address="127.0.0.5")  # of actors, there is one left
            one.wait_for_updates(50)
            other.wait_for_updates(50)
            logs = [(run.folder / "logs" / "launcher.log").read_text() for run in (one, other)]
            assert "actor-0 is ended for it" in logs[0]
            assert "a learner or replay server has no node; ended until it has: actor-1, actor-2" in logs[1]

            _check_list_and_stop(nodes.address, one, other)
            assert other.finish(60) == 130
        assert one.finish(60) == 130


@pytest.mark.long
@pytest.mark.timeout(400)
@pytest.mark.parametrize("nodes", [0], indirect=True)
def test_actors_make_room_for_a_replay_server_and_a_run_goes_on_where_its_rings_are(
    nodes: Cluster, tmp_path: Path
) -> None:
    sizes = {"127.0.0.2": 2, "127.0.0.3": 3, "127.0.0.4": 3}
    at = {address: nodes.add_node(num_cpus=cpus, node_ip_address=address) for address, cpus in sizes.items()}
    folder = tmp_path / "run"
    on_ray = ("--launcher", "ray", "--ray-address", nodes.address)
    with Training(folder, *ENDLESS, *on_ray, "--replay-shards", "2", "--actors", "4") as training:
        training.wait_for_updates(50)
        before = _rings(folder)
        assert len(set(before.values())) == 2
        (learner,) = _learner_node(training)
        role, address = next((role, address) for role, address in before.items() if address != learner)
        nodes.remove_node(at[address], allow_graceful=False)
        training.wait_for(lambda: _rings(folder)[role] != address)
        assert f"no node has room for {role}; actor-" in (folder / "logs" / "launcher.log").read_text()

        nodes.add_node(num_cpus=3, node_ip_address="127.0.0.5")
        training.wait_for_updates(50)
        training.interrupt()
    rings = _rings(folder)
    nodes.add_node(num_cpus=6, node_ip_address="127.0.0.6")  # where there is the most room
    with Training(folder, command=("resume", str(folder))) as training:
        training.wait_for_updates(50)
        assert _rings(folder) == rings
        training.interrupt()


def _rings(folder: Path) -> dict[str, str]:
    """The addresses of the replay servers' nodes, by role."""
    at: dict[str, str] = json.loads((folder / "rings-at").read_text())
    return at


def _learner_node(run: Training) -> list[str]:
    """Its address; none while that is being written."""
    return (run.folder / "learner-at").read_text().split()[:1]


def _check_list_and_stop(address: str, one: Training, other: Training) -> None:
    names = [RunFolder(run.folder).name for run in (one, other)]
    listed = json.loads(rmc("list", "--ray-address", address, "--json", env=ENVIRONMENT).stdout)
    assert {line["run"]: line["folder"] for line in listed} == {
        name: str(run.folder) for name, run in zip(names, (one, other), strict=True)
    }
    first = next(line for line in listed if line["run"] == names[0])
    assert (first["env"], first["total_steps"]) == ("InvertedPendulum-v5", 10_000_000)
    assert first["learner"] in ("127.0.0.2", "127.0.0.3")
    assert one.newest("replay", "env_steps") >= first["env_steps"] > 0
    assert "run" in rmc("list", "--ray-address", address, env=ENVIRONMENT).stdout
    for name, problem in (
        ("none", "is not trained on this cluster; its runs: "),
        ("run", "is the name of several; give one of: "),
    ):
        refused = rmc("stop", name, "--ray-address", address, env=ENVIRONMENT)
        assert refused.returncode == 2
        assert refused.stderr == f"rmc: RUN='{name}': {problem}{', '.join(sorted(names))}\n"
    for run, name in ((one, names[0]), (other, "run")):  # of the second there is only one then
        done = rmc("stop", name, "--ray-address", address, env=ENVIRONMENT)
        assert done.returncode == 0, done.stderr
        assert f"{name} has ended; its folder is {run.folder} on " in done.stdout
        assert max(RunFolder(run.folder).checkpoints.glob("[0-9]*")).is_dir()
