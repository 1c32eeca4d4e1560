"""Several machines on this one, for clusters over real ssh: each a network, PID, mount, UTS and IPC namespace.

Each has an sshd, an address on a bridge, and a /root, /tmp and /dev/shm of its own; the rest of the file system is
shared. The PID namespace keeps one machine's ``ray stop`` away from the others. Needs root, iproute2, openssh-server
and rsync.
"""

import os
import shlex
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from tests.waiting import wait_until

SSHD = "/usr/sbin/sshd"
NEEDED = ["ip", "unshare", "ssh", "ssh-keygen", "rsync"]
BRIDGE = "rmcbridge"
SUBNET, HERE = "10.78.0", 254  # this host's end of the bridge
START_SECONDS = 15.0
SSHD_CONFIG = """
Port 22
ListenAddress {ip}
HostKey {home}/hostkey
AuthorizedKeysFile {home}/root/.ssh/authorized_keys
PidFile none
UsePAM no
StrictModes no
PasswordAuthentication no
PermitRootLogin prohibit-password
MaxSessions 100
MaxStartups 100
Subsystem sftp internal-sftp
"""
# Runs as the first process of a machine: hides this host's folders behind the machine's, but for what it must see.
FIRST = """
mount --make-rprivate /
hostname {name}
{keep}
mount -t tmpfs tmpfs /dev/shm
mkdir -p /run/sshd
mount --rbind {home}/root /root
mount --rbind {home}/tmp /tmp
exec {sshd} -D -e -f {home}/sshd_config
"""


def missing() -> str:
    """Why there can be no machines here; empty where there can."""
    if sys.platform != "linux" or os.geteuid() != 0:
        return "needs root on Linux, for network namespaces"
    lacking = [program for program in NEEDED if shutil.which(program) is None]
    lacking += [] if Path(SSHD).exists() else ["sshd"]
    if lacking:
        return f"needs {', '.join(lacking)} (Debian: openssh-server rsync iproute2)"
    tried = ["unshare", "--mount", "--net", "--pid", "--uts", "--ipc", "--fork", "ip", "link", "add", "rmcprobe"]
    done = subprocess.run([*tried, "type", "bridge"], capture_output=True, text=True)
    return f"no namespaces or bridges may be made here ({done.stderr.strip()})" if done.returncode else ""


class Machine:
    """One of them. ``run`` is a command on it over ssh; ``cut`` takes its network away and ``heal`` gives it back."""

    def __init__(
        self, name: str, ip: str, folder: Path, key: Path, keep: list[Path], environment: dict[str, str]
    ) -> None:
        self.name, self.ip, self._key, self._home = name, ip, key, folder / name
        for path in ("root/.ssh", "tmp"):
            (self._home / path).mkdir(parents=True)
        (self._home / "tmp").chmod(0o1777)
        (self._home / "root" / ".ssh").chmod(0o700)
        shutil.copy(key.with_suffix(".pub"), self._home / "root" / ".ssh" / "authorized_keys")
        _quiet("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(self._home / "hostkey"))
        lines = "".join(f"export {name}={value}\n" for name, value in environment.items())
        for file in (".bashrc", ".bash_profile"):
            (self._home / "root" / file).write_text(lines)
        (self._home / "sshd_config").write_text(SSHD_CONFIG.format(ip=ip, home=self._home))
        self._wire()
        self._process = self._begin(keep)

    def _wire(self) -> None:
        name, link = self.name, f"v{self.name}"
        _quiet("ip", "netns", "add", name)
        _quiet("ip", "link", "add", link, "type", "veth", "peer", "name", "eth0", "netns", name)
        _quiet("ip", "link", "set", link, "master", BRIDGE, "up")
        _quiet("ip", "-n", name, "addr", "add", f"{self.ip}/24", "dev", "eth0")
        _quiet("ip", "-n", name, "link", "set", "eth0", "up")
        _quiet("ip", "-n", name, "link", "set", "lo", "up")

    def _begin(self, keep: list[Path]) -> subprocess.Popen[bytes]:
        binds = []
        for path in keep:
            for hidden in ("root", "tmp"):
                if path.is_relative_to(f"/{hidden}"):
                    target = self._home / hidden / path.relative_to(f"/{hidden}")
                    target.mkdir(parents=True, exist_ok=True)
                    binds.append(f"mount --bind '{path}' '{target}'")
        script = FIRST.format(name=self.name, home=self._home, sshd=SSHD, keep="\n".join(binds))
        words = ["ip", "netns", "exec", self.name, "unshare", "--mount", "--pid", "--uts", "--ipc", "--fork"]
        words += ["--kill-child", "--mount-proc", "bash", "-ec", script]
        with (self._home / "log").open("wb") as log:
            return subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)

    def wait(self) -> None:
        """Until it can be reached."""
        wait_until(lambda: self.run("true", check=False).returncode == 0, START_SECONDS, (self._home / "log").read_text)

    def _ssh(self, command: str) -> list[str]:
        options = ["StrictHostKeyChecking=no", "UserKnownHostsFile=/dev/null", "ConnectTimeout=3", "BatchMode=yes"]
        words = ["ssh", "-q", "-i", str(self._key), *(word for option in options for word in ("-o", option))]
        return [*words, f"root@{self.ip}", f"bash -lc {shlex.quote(command)}"]

    def run(self, command: str, check: bool = True, seconds: float = 120.0) -> subprocess.CompletedProcess[str]:
        """What a command on it gave, under its login shell's settings."""
        done = subprocess.run(
            self._ssh(command), stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=seconds
        )
        assert not check or done.returncode == 0, f"{self.name}: {command}\n{done.stdout}\n{done.stderr}"
        return done

    def background(self, command: str) -> subprocess.Popen[str]:
        """A command on it that runs on while ours does."""
        return subprocess.Popen(
            self._ssh(command), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )

    def processes(self, pattern: str) -> list[int]:
        """Its processes with such a command line."""
        pids = self.run(f"pgrep -f {shlex.quote(pattern)}", check=False).stdout.split()
        return [int(word) for word in pids]

    def wait_until_gone(self, pattern: str, seconds: float) -> None:
        """Until no process has such a command line."""
        wait_until(lambda: not self.processes(pattern), seconds, lambda: f"{self.name}: {self.processes(pattern)}")

    def kill(self, pattern: str) -> None:
        """``kill -9`` them."""
        self.run(f"pkill -9 -f {shlex.quote(pattern)}", check=False)

    def cut(self) -> None:
        """Take its network away."""
        _quiet("ip", "link", "set", f"v{self.name}", "down")

    def heal(self) -> None:
        """Give it back."""
        _quiet("ip", "link", "set", f"v{self.name}", "up")

    def close(self) -> None:
        """End it with all its processes."""
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        _kill_all(self.name)
        _quiet("ip", "link", "del", f"v{self.name}")  # the namespace itself goes when the kernel finds the time
        _quiet("ip", "netns", "del", self.name)


class Machines:
    """A few of them, and the bridge between. ``keep``: folders of this host's /root and /tmp that they see, too."""

    def __init__(self, folder: Path, names: list[str], keep: list[Path], environment: dict[str, str]) -> None:
        self.key = folder / "key"
        self._folder, self._keep, self._environment = folder, keep, environment
        self.machines: list[Machine] = []
        _quiet("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(self.key))
        _clear(names)
        _quiet("ip", "link", "add", BRIDGE, "type", "bridge")
        _quiet("ip", "addr", "add", f"{SUBNET}.{HERE}/24", "dev", BRIDGE)
        _quiet("ip", "link", "set", BRIDGE, "up")
        try:
            for name in names:
                self.add(name)
        except BaseException:
            self.close()
            raise

    def add(self, name: str) -> Machine:
        """One more."""
        ip = f"{SUBNET}.{len(self.machines) + 1}"
        machine = Machine(name, ip, self._folder, self.key, [*self._keep, self._folder], self._environment)
        self.machines.append(machine)
        machine.wait()
        return machine

    def close(self) -> None:
        """End all, and the bridge."""
        for machine in self.machines:
            machine.close()
        _quiet("ip", "link", "del", BRIDGE)


def _quiet(*words: str) -> None:
    subprocess.run(words, check=True, stdin=subprocess.DEVNULL, capture_output=True)


def _clear(names: list[str]) -> None:
    """What a test that was killed has left."""
    for name in [*names, "gamma"]:
        _kill_all(name)
        subprocess.run(["ip", "link", "del", f"v{name}"], capture_output=True)
        subprocess.run(["ip", "netns", "del", name], capture_output=True)
    subprocess.run(["ip", "link", "del", BRIDGE], capture_output=True)


def _kill_all(name: str) -> None:
    """Every process in a network namespace; the first takes the others along."""
    for pid in subprocess.run(["ip", "netns", "pids", name], capture_output=True, text=True).stdout.split():
        with suppress(ProcessLookupError):
            os.kill(int(pid), signal.SIGKILL)
