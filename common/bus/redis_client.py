"""The client of a bus: what Redis answers in error names the command and its keys, and is waited out or told."""

import socket
import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import redis
from redis.client import Pipeline
from redis.exceptions import ResponseError

from rmc.common.bus.redis_url import redacted
from rmc.common.errors import BusFull, BusUnavailable, ConfigError, RmcError

KEYS = "rmc:"  # how every key of ours begins
FULL = {"OOM", "MISCONF", "NOREPLICAS"}  # no memory, no disk for its log, or too few replicas for a write
FIXES = {  # of answers that do not pass; others do: somebody's script, a failover, a cluster that moves slots
    "ERR": "fix that, or give another Redis",
    "WRONGTYPE": "another program uses this key; delete it, or give another database",
    "NOPERM": "let this user do that",
    "ASK": "it is a part of a cluster; give a Redis that is none",
    "MOVED": "it is a part of a cluster; give a Redis that is none",
    "CROSSSLOT": "it is a part of a cluster; give a Redis that is none",
}


def refusal(error: ResponseError, url: str) -> RmcError:
    """What an error that Redis answered means: BusFull, BusUnavailable, or ConfigError where it will not pass."""
    text = str(error)
    code = getattr(error, "status_code", None) or text.partition(" ")[0]
    if code == "ERR":  # so Redis 6 begins for a script, in which the cause stands
        code = next((word for word in text.replace("-", " ").split() if word in FULL | {"READONLY"}), code)
    if code in FULL:
        return BusFull(text)
    if code not in FIXES:
        return BusUnavailable(text)
    return ConfigError("--redis-url", redacted(url), f"it answers {text}; {FIXES[code]}")


def _name(error: ResponseError, command: tuple[Any, ...]) -> None:
    """Add the command and its keys to an error's text, and the code that the client has cut off."""
    words = [word.decode(errors="replace") if isinstance(word, bytes) else str(word) for word in command]
    keys = [word for word in words[1:] if word.startswith(KEYS)]
    code = getattr(error, "status_code", None) or ""
    error.args = (" ".join(f"{code} {error.args[0]} ({' '.join(words[:1] + keys)})".split()),)


@contextmanager
def _naming(command: tuple[Any, ...]) -> Iterator[None]:
    try:
        yield
    except ResponseError as error:
        _name(error, command)
        raise


class _Pipeline(Pipeline):
    def immediate_execute_command(self, *args: Any, **options: Any) -> Any:
        with _naming(args):
            return super().immediate_execute_command(*args, **options)  # type: ignore[no-untyped-call]

    def reset(self) -> None:  # type: ignore[override]  # a command of Redis has that name, too
        """Give the connection back, also where Redis hangs: redis-py would wait for UNWATCH, and then keep it."""
        if self.connection is not None and not self.connection.is_connected:
            self.watching = False  # a new connection watches nothing
        super().reset()

    def annotate_exception(self, exception: Any, _: int, command: Any) -> None:
        _name(exception, tuple(command))


class TlsConnection(redis.SSLConnection):
    """Trusts the certificates that the URL names, and no others of this machine beside them."""

    def _wrap_socket_with_ssl(self, sock: socket.socket) -> ssl.SSLSocket:
        if self.ca_certs is None:
            return super()._wrap_socket_with_ssl(sock)  # type: ignore[no-any-return, no-untyped-call]
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = self.check_hostname, self.cert_reqs
        context.load_verify_locations(self.ca_certs)
        if self.certfile is not None:
            context.load_cert_chain(self.certfile, self.keyfile, self.certificate_password)
        return context.wrap_socket(sock, server_hostname=self.host)


class RedisClient(redis.Redis):
    """A ``redis.Redis`` whose errors name the command and the keys of ours in it, and no values."""

    def pipeline(self, transaction: bool = True, shard_hint: Any = None) -> _Pipeline:
        return _Pipeline(self.connection_pool, self.response_callbacks, transaction, shard_hint)

    def execute_command(self, *args: Any, **options: Any) -> Any:
        with _naming(args):
            return super().execute_command(*args, **options)  # type: ignore[no-untyped-call]
