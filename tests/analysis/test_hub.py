"""Policies to and from a hub, in processes of their own: its library reads the environment when it is imported."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from safetensors.numpy import save

from rmc.analysis.hub import push
from rmc.analysis.model_card import card, renewed
from rmc.analysis.policy_file import decode, read_policy
from rmc.cli import main
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.run.presets import debug
from tests.analysis.hub_stub import TOKEN, Hub
from tests.command import complaint
from tests.hiding import hide
from tests.runs import AGENTS, make_run, run_of

Call = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def hub() -> Iterator[Hub]:
    service = Hub()
    yield service
    service.close()


@pytest.fixture(scope="module")
def call(hub: Hub, tmp_path_factory: pytest.TempPathFactory) -> Call:
    """Python in a process of its own, beside that hub."""
    home = tmp_path_factory.mktemp("home")

    def run(*words: str, folder: Path, token: str = TOKEN, **more: str) -> subprocess.CompletedProcess[str]:
        words = (sys.executable, *words)
        environment = os.environ | hub.environment(home) | {"HF_TOKEN": token} | more
        return subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)

    return run


RMC = ("-m", "rmc.cli.main", "hub")


def test_what_is_pushed_comes_back_and_its_card_says_what_it_is(hub: Hub, call: Call, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", AGENTS["robust"], "Pendulum-v1")
    result = {"eval_return_mean": -1234.5, "eval_return_std": 9.25, "eval_episodes": 10, "initial_return_mean": 0.0}
    run.write_result(result | {"env_steps": 70, "updates": 7, "wall_s": 1.0})
    pushed = call(*RMC, "push", "run", "me/swings", "--license", "mit", "--private", folder=tmp_path)
    summary = "Pendulum-v1 after 70 steps, return -1,234 ± 9 over 10 episodes\n"
    assert (pushed.returncode, pushed.stderr) == (0, ""), pushed.stderr
    assert pushed.stdout == f"{hub.url}/me/swings: {summary}"
    assert hub.private == {"me/swings"}
    files = hub.repos["me/swings"]
    assert sorted(files) == ["README.md", "policy.safetensors"]
    assert list(hub.large.values()) == [files["policy.safetensors"]]
    assert decode(files["policy.safetensors"]).header.eval_return_mean == -1234.5
    front, text = files["README.md"].decode().split("---\n")[1:]
    data = yaml.safe_load(front)
    assert (data["license"], data["library_name"], data["pipeline_tag"]) == ("mit", "rmc", "reinforcement-learning")
    (entry,) = data["model-index"][0]["results"]
    assert entry["metrics"][0]["value"] == "-1234.50 +/- 9.25"
    for row in ("return, mean ± deviation | -1,234 ± 9 over 10 episodes", "agent steps | 70"):
        assert f"| {row} |" in text
    pulled = call(*RMC, "pull", "me/swings", "--out", "back.safetensors", folder=tmp_path, token="")
    assert (pulled.returncode, pulled.stderr, pulled.stdout) == (0, "", f"back.safetensors: {summary}")
    assert (tmp_path / "back.safetensors").read_bytes() == files["policy.safetensors"]


def test_a_return_with_other_options_is_none_of_the_plain_environment(tmp_path: Path) -> None:
    env = EnvConfig("Pendulum-v1", flicker=0.5, delay=2, time_limit=50)
    run = run_of(tmp_path / "run", replace(debug(env), agent=AGENTS["robust"]))
    header = replace(read_policy(run.path).header, eval_return_mean=-9.0, eval_return_std=0.5, eval_episodes=1)
    label = "Pendulum-v1, flicker 0.5, delay 2, time limit 50"
    assert header.summary() == f"{label} after 70 steps, return -9.000 ± 0.500 over 1 episode"
    text = card(header, "me/half", None)
    assert f"| environment | {label} |" in text
    assert "model-index" not in text
    assert "model-index" in card(replace(header, env=EnvConfig("Pendulum-v1", frame_stack=2)), "me/half", None)


def test_the_cards_lines_load_it(hub: Hub, call: Call, tmp_path: Path) -> None:
    make_run(tmp_path / "run", AGENTS["robust"], "Pendulum-v1")
    for _ in range(2):  # into a repository that is there, too
        pushed = call(*RMC, "push", "run", "me/bare", folder=tmp_path)
        assert (pushed.returncode, pushed.stderr) == (0, "")
    assert call(*RMC, "push", "run", "me/bare", "--license", "mit", folder=tmp_path).returncode == 0
    pushed_card = hub.repos["me/bare"]["README.md"].decode()
    more = pushed_card.replace("- Pendulum-v1\n", "- Pendulum-v1\n- arms\n") + "\n## Safety\n\nKeep away.\n"
    old = more.replace("agent steps | 70", "agent steps | 60")
    hub.repos["me/bare"]["README.md"] = old.encode()
    assert call(*RMC, "push", "run", "me/bare", folder=tmp_path).returncode == 0
    assert hub.repos["me/bare"]["README.md"].decode() == more
    by_hand = renewed("---\nlicense: mit\n---\n", pushed_card)  # a repository's of a browser
    assert sorted(by_hand.splitlines()) == sorted(pushed_card.splitlines())
    assert renewed("# My own\n", pushed_card) == "---\nlicense: mit\n---\n# My own\n"
    hub.repos["me/bare"]["README.md"] = b"# My own\n"
    assert call(*RMC, "push", "run", "me/bare", folder=tmp_path).returncode == 0
    assert hub.repos["me/bare"]["README.md"] == b"# My own\n"
    front, text = pushed_card.split("---\n")[1:]
    assert "model-index" not in yaml.safe_load(front)
    assert "| return, mean ± deviation | not evaluated |" in text
    lines = text.split("```python\n")[1].split("```")[0]
    assert len([line for line in lines.splitlines() if line]) <= 5
    shown = "print(action.shape, abs(action[0]) <= 2)"
    played = "from rmc.cli import main\nprint(main.run(['evaluate', 'hf://me/bare', '--episodes', '1']))"
    code = f"observation = [1.0, 0.0, 0.5]\n{lines}\n{shown}\n{played}"
    done = call("-c", code, folder=tmp_path, token="")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("(1,) True\n")
    assert "Pendulum-v1: return" in done.stdout
    assert done.stdout.endswith("\n0\n")


LOUD = """
from huggingface_hub.utils import are_progress_bars_disabled, disable_progress_bars, logging
from rmc import ConfigError, load_policy
for name in ("me/mute", "me/nothing"):
    logging.set_verbosity_info()
    try:
        load_policy(f"hf://{name}")
    except ConfigError:
        pass
    print(are_progress_bars_disabled(), logging.get_verbosity() == logging.INFO)
    disable_progress_bars()
"""


def test_the_programs_own_downloads_are_as_loud_afterwards(hub: Hub, call: Call, tmp_path: Path) -> None:
    path = make_run(tmp_path / "run", AGENTS["robust"], "Pendulum-v1").path / "checkpoints" / "000000007"
    hub.repos["me/mute"] = {"policy.safetensors": (path / "policy.safetensors").read_bytes()}
    done = call("-c", LOUD, folder=tmp_path, token="")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == ["False True", "True True"]


WRONG = [
    (["push", "run", "me/x"], "", "HF_TOKEN=None: no token; set it to one that may write, or run hf auth login"),
    (["push", "run", "me/x"], "hf_reads", "REPO='me/x': the hub refuses it (HTTP 401); use a token that may"),
    (["push", "run", "others/x"], TOKEN, "REPO='others/x': the hub refuses it (HTTP 403); use a token that may"),
    (["push", "run", "swings"], TOKEN, "REPO='swings': no repository's name; give owner/name"),
    (["pull", "swings"], TOKEN, "REPO='swings': no repository's name; give owner/name"),
    (["push", "run", "a/b/c"], TOKEN, "REPO='a/b/c': no repository's name; give owner/name"),
    (
        ["push", "run", "me/x", "--license", "foo"],
        TOKEN,
        "REPO='me/x': the hub refuses it (Invalid metadata in README.md. - \"license\" must be one of these); correct",
    ),
    (["push", "nothing", "me/x"], TOKEN, "RUN='nothing': cannot be read"),
    (["pull", "me/nothing"], "", "REPO='me/nothing': no such repository, or a private one"),
    (["pull", "gated/x"], "", "REPO='gated/x': it wants to be asked; do so at http://127.0.0.1:"),
    (["pull", "me/empty"], "", "REPO='me/empty': it holds no policy.safetensors"),
    (["pull", "me/empty", "--revision", "v9"], "", "--revision='v9': me/empty has no such revision; leave it"),
    (["pull", "me/other"], "", "no policy: its metadata has no rmc.policy"),
    (["pull", "me/other", "--out", "policy.zip"], "", "--out='policy.zip': give a name that ends in .safetensors"),
]
MANY = """
import json, os, sys
from rmc.cli import main
for words, token in json.loads(sys.argv[1]):
    os.environ["HF_TOKEN"] = token
    sys.stderr.write(f"{main.run(['hub', *words])}\\n")
"""


def test_what_goes_wrong_is_one_line(hub: Hub, call: Call, tmp_path: Path) -> None:
    make_run(tmp_path / "run", AGENTS["robust"], "Pendulum-v1")
    hub.repos |= {"me/empty": {}, "me/other": {"policy.safetensors": save({})}}
    before, cases = set(hub.repos), json.dumps([[words, token] for words, token, _ in WRONG])
    done = call("-c", MANY, cases, folder=tmp_path)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    errors = done.stderr.splitlines()
    assert len(errors) == 2 * len(WRONG), done.stderr
    for (_, _, expected), line, status in zip(WRONG, errors[::2], errors[1::2], strict=True):
        assert line.startswith("rmc: ")
        assert expected in line
        assert status == "2"
    assert not (tmp_path / "policy.safetensors").exists()
    assert not any("swings" in name for name in set(hub.repos) - before)


@pytest.mark.parametrize(
    ("words", "more"),
    [("push run me/x", {}), ("push run me/x", {"HF_HUB_OFFLINE": "1"}), ("pull me/x", {"HF_HUB_OFFLINE": "1"})],
)
def test_without_a_network_one_line_says_what_was_tried(
    words: str, more: dict[str, str], call: Call, tmp_path: Path
) -> None:
    make_run(tmp_path / "run", AGENTS["robust"], "Pendulum-v1")
    done = call(*RMC, *words.split(), folder=tmp_path, HF_ENDPOINT="http://127.0.0.1:9", **more)
    (line,) = done.stderr.splitlines()
    assert line.startswith("rmc: HF_ENDPOINT='http://127.0.0.1:9': cannot be reached ("), line


@pytest.mark.parametrize("error", [ConnectionError, TimeoutError, RuntimeError])
def test_where_the_store_of_large_files_fails_one_line_says_so(error: type[Exception]) -> None:
    """That is hf-xet, which raises these."""

    def upload(*_: object, **__: object) -> None:
        raise error("Network error: error sending request\nat once")

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("huggingface_hub.get_token", lambda: TOKEN)
        patched.setattr("huggingface_hub.HfApi.create_repo", upload)
        with pytest.raises(ConfigError, match=r"cannot be reached \(Network error: error sending request\); try again"):
            push("me/x", {}, False)


def test_without_the_extra_one_line_says_how_to_get_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    hide("huggingface_hub", monkeypatch)
    monkeypatch.setattr("rmc.common.extra.how_to_install", lambda extra: f"pip install 'rmc-rl[{extra}]'")
    for words in (["hub", "push", "run", "me/swings"], ["hub", "pull", "me/swings"]):
        assert "huggingface-hub is missing; pip install 'rmc-rl[hub]'" in complaint(words, capsys)
    assert main.run(["hub"]) == 2
