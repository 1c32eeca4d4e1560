"""One actor and one learner as real processes, through a real Redis, from the command line to result.json."""

import json
import os
import re
import subprocess
from contextlib import ExitStack
from pathlib import Path

import pytest
import redis

from rmc.analysis.policy_file import decode
from rmc.deploy.run.folder import RunFolder
from tests.command import COMMAND
from tests.docs.running import ran
from tests.integration.running import Training

MANUAL = Path(__file__).parents[2] / "docs" / "manual.md"

RESULT_KEYS = {
    "env", "preset", "seed", "env_steps", "updates", "wall_s", "eval_return_mean", "eval_return_std", "eval_episodes",
    "replay_ratio",
}  # fmt: skip


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Training:
    """A run that has ended; the tests below use it in their order."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    options = ("--total-steps", "1500", "--checkpoint-steps", "500", "--curiosity", "0.1")
    with Training(folder, *options) as training:
        training.wait_for(lambda: training.role("replay") and training.newest("replay", "windows") > 0)
        replay = training.role("replay")
        assert replay is not None
        assert "libtorch" not in Path(f"/proc/{replay.pid}/maps").read_text()  # it is not forked from what has torch
        assert training.finish(170) == 0, training.text() + training.logs()
    return training


def test_every_metric_is_in_the_glossary(finished: Training) -> None:
    glossary = (Path(__file__).parents[2] / "docs" / "metrics.md").read_text()
    explained = set(re.findall(r"`([a-z_]+)`", glossary))
    names = {name for record in RunFolder(finished.folder).records() for name in record} - {"role", "time"}
    unexplained = {name for name in names - explained if not name.startswith(("restarts_", "dead_letters_"))}
    assert not unexplained


def test_train_evaluate_stats_and_resume(finished: Training) -> None:
    training, folder = finished, finished.folder
    restarts = training.newest("launcher", "restarts", None)
    result = json.loads((folder / "result.json").read_bytes())
    assert result.keys() >= RESULT_KEYS
    assert (result["env"], result["preset"], result["seed"]) == ("InvertedPendulum-v5", "debug", 0)
    assert result["env_steps"] == 1500
    assert restarts == 0
    warmup, train, batch = 500, 15, 16
    assert abs(result["replay_ratio"] - 32) <= 2 * batch * train / (1500 - warmup) + 32 * 0.05
    assert "before training" in training.text()
    assert "after training" in training.text()
    assert list(folder.glob("events.out.tfevents.*"))
    assert {"replay", "learner", "actor-0", "evaluator", "launcher"} <= {
        record["role"] for record in RunFolder(folder).records()
    }

    *_, newest = sorted((folder / "checkpoints").glob("*/policy.safetensors"))  # a copy of which is enough
    header = decode(newest.read_bytes()).header
    assert (header.env.id, header.env_steps, header.updates) == (result["env"], 1500, result["updates"])

    evaluation = json.loads(ran(folder.parent, "evaluate", str(folder), "--json"))
    assert evaluation["eval_return_mean"] == result["eval_return_mean"]  # the same path, the same starts
    assert "InvertedPendulum-v5 · debug · seed 0 · finished" in ran(folder.parent, "stats", str(folder))

    with Training(folder, "--total-steps", "2000", "--checkpoint-steps", "500") as resumed:
        assert resumed.finish(170) == 0, resumed.text() + resumed.logs()
    longer = json.loads((folder / "result.json").read_bytes())
    assert longer["env_steps"] == 2000
    assert longer["updates"] > result["updates"]
    assert longer["wall_s"] > result["wall_s"]


def test_roles_by_hand_over_tcp(redis_url: str, run_name: str, tmp_path: Path) -> None:
    """As docs/manual.md says it, from files that the command lines name; the learner from the environment."""
    folder = tmp_path / run_name
    (tmp_path / "redis-url").write_text(redis_url + "\n")
    begin, *commands = re.findall(r"^rmc (.*)$", MANUAL.read_text(), re.MULTILINE)
    options = ("--launcher", "manual", "--redis-url", f"file:{tmp_path}/redis-url")
    assert " ".join(options[:3]) in begin
    assert [command.split()[1] for command in commands] == ["replay", "learner", "actor", "evaluator"]
    with ExitStack() as stack:
        training = stack.enter_context(Training(folder, "--total-steps", "1200", "--checkpoint-steps", "600", *options))
        training.wait_for(lambda: "start the roles with" in training.text())
        name = training.text().partition("--run=")[2].split()[0]
        told = {"RMC_SECRET": (folder / "secret").read_text().strip(), "RMC_REDIS_URL": redis_url}
        places = {"NAME": name, "file:redis-url": options[-1], "runs/by-hand": str(folder)}
        roles = []
        for command in commands:
            by_environment = command.startswith("role learner ")
            words = re.sub(r" --(secret-file|redis-url) \S+", "", command) if by_environment else command
            environment = os.environ | told if by_environment else os.environ
            for word, place in places.items():
                words = words.replace(word, place)
            log = stack.enter_context((tmp_path / f"{words.split()[1]}.log").open("wb"))
            line = [*COMMAND, *words.split()]
            roles.append(subprocess.Popen(line, env=environment, stdout=subprocess.DEVNULL, stderr=log))
        for role in roles:
            stack.callback(role.wait)
            stack.callback(role.kill)
        training.wait_for(lambda: training.newest("learner", "updates") > 0)
        assert "libtorch" not in Path(f"/proc/{roles[0].pid}/maps").read_text()  # the replay server has no network
        assert "libtorch" in Path(f"/proc/{roles[1].pid}/maps").read_text()
        assert training.finish(150) == 0, training.text()
        assert [role.wait(20) for role in roles] == [0, 0, 0, 0]
    assert json.loads((folder / "result.json").read_bytes())["env_steps"] == 1200
    left = redis.Redis.from_url(redis_url)
    keys = [key for key in left.scan_iter() if key.startswith(f"rmc:{name}:".encode())]
    assert keys
    assert all(0 < left.ttl(key) <= 3600 for key in keys)
