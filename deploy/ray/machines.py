"""``rmc cluster up`` and ``down``: ``ray up`` and ``ray down`` with what these leave undone (docs/cluster.md)."""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console

from rmc.common.errors import ConfigError, RmcError, one_line
from rmc.common.user_path import user_path

UP_SECONDS = 900.0  # for all nodes to have joined once the head is up: new machines install everything first
LOOK_SECONDS = 2.0
TOKEN = "~/.ray/auth_token"
# Counts what is alive; run on the head.
COUNT = (
    "import ray; ray.init(address='auto', logging_level='ERROR'); print('alive', sum(n['Alive'] for n in ray.nodes()))"
)
# how many of the user's processes of Ray, or that keep it, are on a machine, once they have had 10 s to end
_RAYS = "[r]aylet/raylet|[g]cs_server|[r]ay::|/[r]ay/(dashboard|autoscaler|_private)/|[c]luster/worker.sh"
LEFT = f"for i in $(seq 20); do n=$(pgrep -u $(id -u) -fc '{_RAYS}'); [ $n = 0 ] && break; sleep 0.5; done; echo $n"


def up(path: Path, console: Console) -> None:
    """Bring a cluster up and wait until every node that its file promises is there. Raises RmcError."""
    config = read_cluster_file(path)
    secure_token()
    console.print(f"ray up {path}", soft_wrap=True)
    _ray("up", "-y", str(path))
    expected = expected_nodes(config)
    deadline = time.monotonic() + UP_SECONDS
    while (alive := _alive(path)) < expected:
        if time.monotonic() > deadline:
            fix = "look at the workers' setup by ray monitor, and fix or take them out of the file"
            raise RmcError(f"{path}: {alive} of {expected} nodes are there after {UP_SECONDS:.0f} s; {fix}")
        time.sleep(LOOK_SECONDS)
    console.print(f"{alive} nodes are up; ray attach {path} goes to the head", soft_wrap=True)


def down(path: Path, console: Console) -> None:
    """Take a cluster down; on machines of one's own also what ``ray down`` leaves running. Raises RmcError."""
    config = read_cluster_file(path)
    console.print(f"ray down {path}", soft_wrap=True)
    _ray("down", "-y", str(path))
    if config["provider"]["type"] != "local":
        return
    running = {}
    for address in [config["provider"]["head_ip"], *config["provider"]["worker_ips"]]:
        _ssh(config, address, _stop_command(config))
        count = _ssh(config, address, LEFT).strip().splitlines()[-1:]
        if count != ["0"]:
            running[address] = " ".join(count) or "no answer"
    if running:
        raise RmcError(f"{path}: Ray still runs on {running}; ssh there and run ray stop --force")
    console.print("no process of Ray is left on any node")


def read_cluster_file(path: Path) -> dict[str, Any]:
    """A cluster's file. Raises ConfigError where it is none."""
    try:
        config = yaml.safe_load(path.read_text())
    except OSError as error:
        raise ConfigError("CONFIG", str(path), f"cannot be read ({error.strerror}); give a cluster's file") from None
    except (UnicodeError, yaml.YAMLError) as error:
        raise ConfigError("CONFIG", str(path), f"is not YAML ({one_line(error)}); fix it") from None
    provider = config.get("provider") if isinstance(config, dict) else None
    if not isinstance(provider, dict) or "type" not in provider:
        raise ConfigError("CONFIG", str(path), "is no Ray cluster's file; start from one in deploy/cluster/")
    if provider["type"] == "local" and not {"head_ip", "worker_ips"} <= provider.keys():
        raise ConfigError("CONFIG", str(path), "its provider has no head_ip or worker_ips; write the machines into it")
    return dict(config)


def expected_nodes(config: dict[str, Any]) -> int:
    """How many nodes there must be once all is up: the head and all workers that are always wanted."""
    if config["provider"]["type"] == "local":
        there = len(config["provider"]["worker_ips"])
        return 1 + min(there, *(int(config.get(limit, there)) for limit in ("min_workers", "max_workers")))
    kinds = config.get("available_node_types", {})
    head = config.get("head_node_type")
    return 1 + sum(int(kind.get("min_workers", 0)) for name, kind in kinds.items() if name != head)


def secure_token() -> None:
    """Make Ray's token where there is none, and let only its owner read it."""
    path = user_path(TOKEN)
    mask = os.umask(0o077)
    try:
        if not path.exists():
            _ray("get-auth-token", "--generate", quiet=True)
    finally:
        os.umask(mask)
    if not path.exists():
        raise ConfigError("cluster", str(path), "Ray made no token there; unset RAY_AUTH_TOKEN and RAY_AUTH_TOKEN_PATH")
    path.chmod(0o600)


def _ray(*words: str, quiet: bool = False) -> str:
    """Run Ray's own command line, its words seen unless ``quiet``. Raises RmcError."""
    environment = {**os.environ, "RAY_AUTH_MODE": "token", "RAY_UP_enable_autoscaler_v2": "0"}
    captured = subprocess.PIPE if quiet else None
    program = [sys.executable, "-P", "-m", "ray.scripts.scripts"]
    done = subprocess.run(
        [*program, *words], env=environment, stdin=subprocess.DEVNULL, stdout=captured, stderr=captured, text=True
    )
    if done.returncode and not quiet:
        raise RmcError(f"ray {' '.join(words)} ended with status {done.returncode}")
    return done.stdout or ""


def _alive(path: Path) -> int:
    output = _ray("exec", str(path), f'PATH=~/rmc-env/bin:$PATH RAY_AUTH_MODE=token python3 -c "{COUNT}"', quiet=True)
    counts = [line.split()[1] for line in output.splitlines() if line.startswith("alive ")]
    return int(counts[-1]) if counts else 0


def _stop_command(config: dict[str, Any]) -> str:
    """By the program that starts Ray on the workers."""
    commands = [line for line in config.get("worker_start_ray_commands", []) if "ray start" in line]
    return f"{commands[0].partition('ray start')[0] if commands else ''}ray stop --force"


def _ssh(config: dict[str, Any], address: str, command: str) -> str:
    auth = config.get("auth", {})
    key = ["-i", str(user_path(auth["ssh_private_key"]))] if "ssh_private_key" in auth else []
    options = ["-o", "BatchMode=yes", "-o", "StrictHostKeyChecking=no", "-o", "UserKnownHostsFile=/dev/null"]
    login = f"{auth.get('ssh_user', os.environ.get('USER', ''))}@{address}"
    words = ["ssh", "-q", *key, *options, "-o", "ConnectTimeout=10", login, command]
    return subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, text=True).stdout
