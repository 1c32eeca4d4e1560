"""The Dockerfile's steps in a chroot, and what they made at work: make test-container. Linux, root, debootstrap.

Debian's own Python stands for the base image; a test of ``test_container.py`` holds their versions together.
RMC_TORCH_INDEX names another place for torch than the Dockerfile's.
"""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.packaging.container import Image
from tests.packaging.test_container import CHROOT, DOCKERFILE, ROOT, STRANGER

pytestmark = [
    pytest.mark.timeout(1800),
    CHROOT,
    pytest.mark.skipif(shutil.which("debootstrap") is None, reason="wants debootstrap, a package of Debian's"),
]
RELEASE, PACKAGES = "bookworm", "python3,python3-venv,ca-certificates"
NETWORK = ("/etc/resolv.conf", "/etc/ssl/certs/ca-certificates.crt")
ENVIRONMENT = """
import gymnasium as gym
from gymnasium.envs.classic_control import PendulumEnv

gym.register("Swing-v0", PendulumEnv, max_episode_steps=50)
"""


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Image:
    root = tmp_path_factory.mktemp("image") / "root"
    debootstrap = ["debootstrap", "--variant=minbase", f"--include={PACKAGES}", RELEASE, str(root)]
    subprocess.run(debootstrap, check=True, stdout=subprocess.DEVNULL)
    for path in filter(os.path.exists, NETWORK):  # this machine's, so that pip finds its index from in there
        shutil.copy(path, root / path.lstrip("/"))
    pip = {name: value for name, value in os.environ.items() if name.startswith(("PIP_", "SSL_CERT"))}
    wheels = [Path(word) for word in pip.get("PIP_FIND_LINKS", "").split() if Path(word).is_dir()]
    torch = {"TORCH_INDEX": os.environ["RMC_TORCH_INDEX"]} if "RMC_TORCH_INDEX" in os.environ else {}
    built = Image(root, ROOT, bound=wheels)
    built.build(DOCKERFILE, torch, pip)
    built.bound = []
    return built


@pytest.fixture
def work(tmp_path: Path, image: Image) -> Path:
    folder = tmp_path / "work"
    folder.mkdir()
    os.chown(folder, image.uid(), image.uid())
    return folder


def rmc(image: Image, work: Path, *words: str, uid: int | None = None) -> str:
    done = image.run(list(words), work, uid)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    return done.stdout


def test_it_holds_torch_for_the_cpu_and_no_sources(image: Image, work: Path) -> None:
    assert (image.user, image.folder, image.entrypoint) == ("rmc", "/work", ["rmc"])
    assert rmc(image, work, "--version").startswith("rmc ")
    assert not (image.root / "src").exists()
    image.entrypoint = ["python3"]
    versions = rmc(image, work, "-c", "import sys, torch; print(torch.version.cuda, *sys.version_info[:2])")
    image.entrypoint = ["rmc"]
    (python,) = re.findall(r"FROM python:([\d.]+)-slim", DOCKERFILE)
    assert versions == f"None {python.replace('.', ' ')}\n"


def test_a_run_from_its_start_to_its_policy(image: Image, work: Path) -> None:
    options = ["--preset", "debug", "--total-steps", "1500"]
    assert "after training:  return" in rmc(image, work, "train", "InvertedPendulum-v5", *options)
    (run,) = (work / "runs").iterdir()
    assert json.loads((run / "result.json").read_bytes())["env_steps"] >= 1500
    assert "return" in rmc(image, work, "export", f"runs/{run.name}", "--out", "policy.safetensors")
    assert "over 2 episodes" in rmc(image, work, "evaluate", "policy.safetensors", "--episodes", "2")
    assert {path.name for path in work.iterdir()} == {"runs", ".cache", "policy.safetensors"}


def test_the_pages_commands_run_for_a_user_whom_the_image_does_not_know(image: Image, work: Path) -> None:
    """All of them with the few rights of the last one, and with an environment of the user's own."""
    os.chown(work, STRANGER, STRANGER)
    (work / "swing.py").write_text(ENVIRONMENT)
    page = (ROOT / "docs" / "container.md").read_text()
    commands = [command.split() for command in re.findall(r"^docker run .* rmc (.*)$", page, re.MULTILINE)]
    own = ["train", "swing:Swing-v0", "--preset", "debug", "--run-dir", "own"]
    assert [words[0] for words in commands] == ["train", "evaluate", "train"]
    for words in [*commands, own]:
        shorter = ["--total-steps", "1000"] * (words[0] == "train")
        assert "return" in rmc(image, work, *words, *shorter, uid=STRANGER)
    files = [path for path in work.rglob("*") if path.name != "swing.py"]
    assert {path.stat().st_uid for path in files} == {STRANGER}
    assert sum(path.stat().st_size for path in (work / ".cache").rglob("*")) < 1 << 20
