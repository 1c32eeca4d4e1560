"""The steps of a Dockerfile, done in a chroot: for machines without a container engine. Linux, root."""

import json
import os
import re
import shlex
import shutil
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

SHM_BYTES = 64 << 20  # what a container engine gives by default
DEVICES = {"null": 3, "zero": 5, "random": 8, "urandom": 9}  # of major number 1
Step = tuple[str, str]


def steps(text: str) -> list[Step]:
    """A Dockerfile's instructions in order, with what follows them."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", "", "\n".join(lines)).splitlines()
    return [(word, rest.strip()) for word, _, rest in (line.partition(" ") for line in joined)]


@dataclass
class Image:
    """What a Dockerfile has made of a root folder that holds its base already."""

    root: Path
    context: Path
    base: str = ""
    environment: dict[str, str] = field(default_factory=dict)
    arguments: dict[str, str] = field(default_factory=dict)
    user: str = "root"
    folder: str = "/"
    entrypoint: list[str] = field(default_factory=list)
    bound: list[Path] = field(default_factory=list)
    """What lies outside of ``root`` and is seen in there, at the same place."""

    def build(self, dockerfile: str, arguments: dict[str, str], hidden: dict[str, str]) -> None:
        """Do every step; ``hidden`` is what pip needs to know here, and is forgotten. Raises CalledProcessError."""
        for instruction, text in steps(dockerfile):
            match instruction:
                case "FROM":
                    self.base = text
                case "ARG":
                    name, _, default = text.partition("=")
                    self.arguments[name] = arguments.get(name, default)
                case "ENV":
                    self.environment |= dict(word.split("=", 1) for word in shlex.split(text))
                case "COPY":
                    self._copy(*text.split())
                case "RUN":
                    self._shell(["/bin/sh", "-c", text], self.environment | self.arguments | hidden)
                case "USER":
                    self.user = text
                case "WORKDIR":
                    self.folder = text
                case "ENTRYPOINT":
                    self.entrypoint = json.loads(text)
                case other:
                    raise ValueError(f"Dockerfile: no {other} here; teach it to tests/packaging/container.py")

    def _copy(self, source: str, target: str) -> None:
        """What .dockerignore leaves of it."""
        there = self.root / target.lstrip("/")
        there.mkdir(parents=True, exist_ok=True)
        names = kept(self.context) if source == "." else {source}
        for name in names & set(os.listdir(self.context)):
            path = self.context / name
            if path.is_dir():
                unwanted = shutil.ignore_patterns("__pycache__")
                shutil.copytree(path, there / name, ignore=unwanted, dirs_exist_ok=True)
            else:
                shutil.copy(path, there)

    def _shell(self, words: list[str], environment: dict[str, str]) -> None:
        seen = [f"mkdir -p {self.root}{path} && mount --bind {path} {self.root}{path}" for path in self.bound]
        mounts = " && ".join(["mount -t proc proc {0}/proc", "mount --rbind /dev {0}/dev", *seen]).format(self.root)
        inside = ["chroot", str(self.root), "/usr/bin/env", "-i", *(f"{k}={v}" for k, v in environment.items()), *words]
        _in_namespace(f"{mounts} && exec {shlex.join(inside)}").check_returncode()

    def run(self, words: list[str], folder: Path, uid: int | None = None) -> subprocess.CompletedProcess[str]:
        """The entry point, as its user or another: the root read-only, little shared memory, no network.

        As ``docker run --read-only --network none --cap-drop ALL --volume FOLDER:/work``: only ``folder`` and the
        shared memory can be written.
        """
        root, uid = self.root, self.uid() if uid is None else uid
        mounts = [
            f"mount --bind {root} {root}",
            *(f"mount --bind {path} {root}{path} && mount -o remount,ro,bind {root}{path}" for path in self.bound),
            f"mount --bind {folder} {root}{self.folder}",
            f"mount -o remount,ro,bind {root}",
            f"mount -t proc proc {root}/proc",
            f"mount -t tmpfs -o size=64k,mode=755 tmpfs {root}/dev",
            *(f"mknod -m 666 {root}/dev/{name} c 1 {minor}" for name, minor in DEVICES.items()),
            f"mkdir {root}/dev/shm",
            f"mount -t tmpfs -o size={SHM_BYTES},mode=1777,noexec,nosuid,nodev tmpfs {root}/dev/shm",
        ]
        environment = [f"{name}={value}" for name, value in self.environment.items()]
        inside = ["chroot", f"--userspec={uid}:{uid}", "--groups=", str(root), "/usr/bin/env", "-i", *environment]
        inside += ["/bin/sh", "-c", f"cd {self.folder} && exec {shlex.join([*self.entrypoint, *words])}"]
        return _in_namespace(" && ".join([*mounts, f"exec {shlex.join(inside)}"]), "--net")

    def uid(self) -> int:
        """Its user's number."""
        users = [line.split(":") for line in (self.root / "etc" / "passwd").read_text().splitlines()]
        return next(int(user[2]) for user in users if user[0] == self.user)


def kept(context: Path) -> set[str]:
    """The names at the top that .dockerignore keeps: all but these are left out there."""
    lines = [line for line in (context / ".dockerignore").read_text().splitlines() if line and line[0] != "#"]
    assert lines[0] == "*"
    assert {line for line in lines[1:] if not line.startswith("!")} == {"**/__pycache__"}
    return {line[1:] for line in lines if line.startswith("!")}


def _in_namespace(script: str, *more: str) -> subprocess.CompletedProcess[str]:
    """Mounts and processes of its own, which end with it."""
    words = ["unshare", "--mount", "--pid", "--fork", "--kill-child", *more, "sh", "-c", script]
    return subprocess.run(words, capture_output=True, text=True, timeout=1500, check=False)
