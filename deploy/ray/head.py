"""A Ray cluster's head, asked before Ray joins it: where none answers, Ray itself tries for a quarter of an hour."""

import os
from contextlib import suppress
from pathlib import Path

import grpc
import psutil
from ray._private.services import canonicalize_bootstrap_address

from rmc.common.errors import ConfigError
from rmc.common.user_path import user_path

ANSWER_SECONDS = 5.0
QUESTION = "/ray.rpc.NodeInfoGcsService/CheckAlive"
DIRECT = [("grpc.enable_http_proxy", 0)]  # as Ray goes
FIX = "give the HOST:PORT of its ray start --head, auto on one of its nodes, or local for one of your own"


def check_head(address: str) -> None:
    """Raises ConfigError where no head answers, or no node is here; OSError, ValueError where none can be asked."""
    if "://" in address:
        raise ConfigError("--ray-address", address, f"is a URL; {FIX}")
    at = canonicalize_bootstrap_address(address)
    if at is None:  # RAY_ADDRESS says local
        return
    try:
        with _channel(at) as channel:
            channel.unary_unary(QUESTION)(b"", timeout=ANSWER_SECONDS, metadata=_token(address))
    except grpc.RpcError as error:
        raise ConfigError("--ray-address", address, _fix(error.code(), at)) from None
    if not any(process.info["name"] == "raylet" for process in psutil.process_iter(["name"])):
        raise ConfigError("--ray-address", address, "this machine is no node of the cluster; go to one, by ray attach")


def _fix(code: grpc.StatusCode, at: str) -> str:
    if code == grpc.StatusCode.UNAUTHENTICATED:
        return f"{at} wants its token; set RAY_AUTH_MODE=token, and bring the head's ~/.ray/auth_token here"
    if code in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.DEADLINE_EXCEEDED):
        return f"no Ray cluster answers at {at}; {FIX}"
    return f"no Ray cluster answers at {at}, but something else; {FIX}"


def _channel(at: str) -> grpc.Channel:
    """Encrypted where Ray's own are."""
    if os.environ.get("RAY_USE_TLS", "0").lower() not in ("1", "true"):
        return grpc.insecure_channel(at, DIRECT)
    files = (Path(os.environ.get(f"RAY_TLS_{name}", "")) for name in ("CA_CERT", "SERVER_KEY", "SERVER_CERT"))
    return grpc.secure_channel(at, grpc.ssl_channel_credentials(*(file.read_bytes() for file in files)), DIRECT)


def _token(address: str) -> list[tuple[str, str]]:
    """The token, where Ray would send it."""
    if os.environ.get("RAY_AUTH_MODE", "token" if address == "auto" else "").lower() != "token":
        return []
    token, file = os.environ.get("RAY_AUTH_TOKEN"), os.environ.get("RAY_AUTH_TOKEN_PATH", "~/.ray/auth_token")
    with suppress(OSError):
        token = token or user_path(file).read_text().strip()
    return [("authorization", f"Bearer {token}")] if token else []
