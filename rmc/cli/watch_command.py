"""``rmc watch``."""

import ipaddress
import secrets
import socket
from contextlib import suppress

from rmc.analysis.run_paths import each_readable
from rmc.cli import run_options
from rmc.common.extra import check_installed
from rmc.deploy.monitor.view import terminal
from rmc.deploy.run.preflight import listening

ANY = ("0.0.0.0", "::")


def watch(command: run_options.Watch) -> int:
    check_installed("watch", ("starlette", "uvicorn"), "RUNS", " ".join(map(str, command.runs)))
    from rmc.analysis.live_run import LiveRun
    from rmc.analysis.watch_server import serve  # an extra

    runs = each_readable(command.runs, lambda path: LiveRun(str(path), path))
    with listening(command.host, command.port, "--host", "--port") as listener:
        address, port = listener.getsockname()[:2]
        token = "" if ipaddress.ip_address(address).is_loopback else secrets.token_urlsafe()
        host = socket.gethostname() if address in ANY else command.host
        host = f"[{host}]" if ":" in host else host
        terminal().print(f"http://{host}:{port}/" + (f"?token={token}" if token else ""), soft_wrap=True)
        with suppress(KeyboardInterrupt):
            serve(runs, listener, host, token)
    return 0
