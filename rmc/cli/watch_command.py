"""``rmc watch``."""

import ipaddress
import os
import secrets
import socket
from contextlib import suppress

from rmc.analysis.run_paths import each_readable
from rmc.cli import run_options
from rmc.common.errors import ConfigError
from rmc.common.extra import check_installed
from rmc.deploy.monitor.view import terminal

ANY = ("0.0.0.0", "::")


def watch(command: run_options.Watch) -> int:
    check_installed("watch", ("starlette", "uvicorn"), "RUNS", " ".join(map(str, command.runs)))
    from rmc.analysis.live_run import LiveRun
    from rmc.analysis.watch_server import serve  # an extra

    runs = each_readable(command.runs, lambda path: LiveRun(str(path), path))
    with _listening(command.host, command.port) as listener:
        address, port = listener.getsockname()[:2]
        token = "" if ipaddress.ip_address(address).is_loopback else secrets.token_urlsafe()
        host = socket.gethostname() if address in ANY else command.host
        host = f"[{host}]" if ":" in host else host
        terminal().print(f"http://{host}:{port}/" + (f"?token={token}" if token else ""), soft_wrap=True)
        with suppress(KeyboardInterrupt):
            serve(runs, listener, host, token)
    return 0


def _listening(host: str, port: int) -> socket.socket:
    """Raises ConfigError where there is no such address, or the port is taken."""
    if not 0 <= port < 1 << 16:
        raise ConfigError("--port", str(port), "must be between 0 and 65535")
    try:
        (family, _, _, _, address), *_ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        return socket.create_server(address[:2], family=family)
    except (socket.gaierror, UnicodeError):
        raise ConfigError("--host", host, "is no address; give one of this machine, like 127.0.0.1") from None
    except OSError as error:
        reason = os.strerror(error.errno or 0)  # its own repeats the address
        raise ConfigError("--port", f"{host}:{port}", f"{reason}; give another, or 0 for a free one") from None
