"""The socket that a replay server listens at."""

import errno
import os
import socket
import stat
from contextlib import suppress
from pathlib import Path

from rmc.common.errors import ConfigError

BACKLOG = 32  # connections that wait to be accepted


def listen(address: str) -> tuple[socket.socket, Path | None, str]:
    """A non-blocking socket that listens, its file if any, and its address with the port taken.

    ``address`` is ``unix:PATH`` or ``tcp:HOST:PORT``; port 0 takes a free one. Raises ConfigError.
    """
    scheme, _, rest = address.partition(":")
    try:
        if scheme == "unix":
            return _listen_unix(Path(rest)), Path(rest), address
        host, _, port = rest.rpartition(":")
        if scheme == "tcp" and host and port.isdecimal() and int(port) < 65536:
            listener = socket.create_server((host, int(port)), backlog=BACKLOG)
            listener.setblocking(False)
            return listener, None, f"tcp:{host}:{listener.getsockname()[1]}"
    except (OSError, ValueError) as error:  # the latter for a path with a NUL
        fix = f"cannot listen there ({error})"
        if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
            taken = "the port is taken; choose another, or 0 for a free one"
            fix = "a file is there; choose another path" if scheme == "unix" else taken
        raise ConfigError("replay address", address, fix) from None
    raise ConfigError("replay address", address, "want unix:PATH or tcp:HOST:PORT")


def _listen_unix(path: Path) -> socket.socket:
    with suppress(FileNotFoundError):
        if stat.S_ISSOCK(os.lstat(path).st_mode):  # a killed server's; the ring's lock keeps a living one's safe
            path.unlink()
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        mask = os.umask(0o177)
        try:
            listener.bind(str(path))
        finally:
            os.umask(mask)
        listener.listen(BACKLOG)
    except OSError:
        listener.close()
        raise
    listener.setblocking(False)
    return listener
