"""The cluster files that the project ships are Ray's own idea of one, and say what must not be left to chance."""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import jsonschema
import psutil
import pytest
import ray.autoscaler

from rmc import deploy
from rmc.common.errors import ConfigError
from rmc.deploy.ray import machines
from tests.waiting import wait_until

FOLDER = Path(deploy.__file__).parent / "cluster"
FILES = sorted(FOLDER.glob("*.yaml"))
SCHEMA = json.loads((Path(ray.autoscaler.__file__).parent / "ray-schema.json").read_text())
PINS = (FOLDER.parents[1] / "constraints.txt").read_text()


@pytest.fixture(params=FILES, ids=lambda path: path.stem)
def config(request: pytest.FixtureRequest) -> dict[str, Any]:
    return machines.read_cluster_file(request.param)


def test_there_is_one_for_each_provider() -> None:
    assert [path.stem for path in FILES] == ["aws", "gcp", "on-premise"]


def test_ray_takes_it(config: dict[str, Any]) -> None:
    jsonschema.validate(config, SCHEMA)


def test_authentication_is_on_and_the_dashboard_at_home(config: dict[str, Any]) -> None:
    starts = [config["head_start_ray_commands"][-1], config["worker_start_ray_commands"][-1]]
    assert all(start.startswith("RAY_AUTH_MODE=token ") and "ray start" in start for start in starts)
    assert all("--node-ip-address=" in start for start in starts)
    assert "--dashboard-host=127.0.0.1" in starts[0]
    assert config["file_mounts"]["~/.ray/auth_token"] == "~/.ray/auth_token"
    assert "chmod 600 ~/.ray/auth_token" in config["setup_commands"]


def test_versions_are_the_pinned_ones(config: dict[str, Any]) -> None:
    installs = [command for command in config["setup_commands"] if "pip install" in command]
    assert len(installs) == 2
    assert all("-c ~/rmc/constraints.txt" in command for command in installs)
    assert "torch==2.13.0" in installs[0]
    assert "torch==2.13.0" in PINS
    assert config["file_mounts"]["~/rmc"] == "."


def test_every_cloud_machine_says_its_image(config: dict[str, Any]) -> None:
    for kind in config.get("available_node_types", {}).values():
        if config["provider"]["type"] != "local":
            assert "ubuntu" in str(kind["node_config"])  # with a Python that is new enough


def test_the_nodes_that_there_must_be() -> None:
    nodes = {path.stem: machines.expected_nodes(machines.read_cluster_file(path)) for path in FILES}
    assert nodes == {"aws": 3, "gcp": 3, "on-premise": 3}
    local = machines.read_cluster_file(FOLDER / "on-premise.yaml")
    assert [machines.expected_nodes(local | {"min_workers": number}) for number in (0, 1, 9)] == [1, 2, 3]


@pytest.mark.parametrize("there", [(".bash_profile", ".bash_login", ".profile"), (".bash_login", ".profile"), ()])
def test_a_login_shell_finds_the_programs(config: dict[str, Any], tmp_path: Path, there: tuple[str, ...]) -> None:
    for name in there:
        (tmp_path / name).touch()
    for _ in range(2):
        subprocess.run(["bash", "-c", config["setup_commands"][-1]], env={"HOME": str(tmp_path)}, check=True)
    words = ["bash", "--login", "-c", "echo $RAY_AUTH_MODE $PATH"]
    said = subprocess.run(words, env={"HOME": str(tmp_path), "PATH": "/bin"}, capture_output=True, text=True).stdout
    assert said.startswith(f"token {tmp_path}/rmc-env/bin:")
    assert said.count("rmc-env") == 1


@pytest.mark.skipif(os.getuid() != 0, reason="only root becomes another user")
def test_what_another_user_runs_is_not_counted() -> None:
    """The one who counts is nobody, who has no Ray beside this test."""
    nobody, raylet = (
        ["setpriv", "--reuid", "65534", "--clear-groups"],
        ["bash", "-c", "exec -a /x/raylet/raylet sleep 60"],
    )
    count = [*nobody, "bash", "-c", machines.LEFT.replace("seq 20", "seq 1")]
    found = []
    for words in (raylet, [*nobody, *raylet]):
        with subprocess.Popen(words) as process:
            running = psutil.Process(process.pid)
            wait_until(lambda running=running: running.cmdline() == ["/x/raylet/raylet", "60"], 10)
            found += subprocess.run(count, capture_output=True, text=True).stdout.split()
            process.kill()
    assert found == ["0", "1"]


def test_a_file_that_is_none_is_named(tmp_path: Path) -> None:
    odd = tmp_path / "odd.yaml"
    for text, message in [
        ("[1, 2]", "is no Ray cluster's file"),
        ("a: [", "is not YAML"),
        ("provider: 3", "is no Ray"),
        ("provider: {type: local, coordinator_address: a:1}", "has no head_ip or worker_ips"),
    ]:
        odd.write_text(text)
        with pytest.raises(ConfigError, match=message):
            machines.read_cluster_file(odd)
    odd.write_bytes(b"\xff\xfe\x00")
    for file, message in ((odd, "is not YAML"), (tmp_path / "absent.yaml", r"No such file or directory\); give a")):
        with pytest.raises(ConfigError, match=message):
            machines.read_cluster_file(file)


def test_the_token_is_made_and_private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    machines.secure_token()
    path = tmp_path / ".ray" / "auth_token"
    first = path.read_text()
    assert len(first) >= 32
    path.chmod(0o644)
    machines.secure_token()
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.read_text() == first
