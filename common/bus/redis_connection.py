"""A connection to one run's keys in Redis: what an outage, a refusal or an unreadable value means."""

import re
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar
from urllib.parse import parse_qs, urlsplit

import redis
from redis.backoff import ExponentialBackoff
from redis.retry import Retry

from rmc.common.bus.redis_client import RedisClient, TlsConnection, refusal
from rmc.common.bus.redis_url import HIDDEN, fault, redacted
from rmc.common.errors import BusUnavailable, ConfigError

TIMEOUT_SECONDS = 3.0  # that Redis may take for an answer; two of them are less than a learner waits for a batch
TIMEOUTS, TIMEOUT_LIMIT = {"socket_timeout", "socket_connect_timeout"}, 1e6  # that a URL may name; seconds
OPTIONS = TIMEOUTS | {  # that may follow its question mark; others change what an answer is
    "db", "username", "password", "client_name", "health_check_interval", "socket_keepalive", "ssl_ca_certs",
    "ssl_certfile", "ssl_keyfile", "ssl_password", "ssl_cert_reqs", "ssl_check_hostname",
}  # fmt: skip
INTEGER = re.compile(rb"-?[0-9]{1,18}")
T = TypeVar("T")


class RedisConnection:
    """Calls one Redis for one run. Not thread-safe: one per thread.

    Redis's own retries are short (a lost reply is repeated, which explicit ids make harmless);
    an outage longer than that raises BusUnavailable and the role's loop waits.
    """

    def __init__(self, url: str, run: str) -> None:
        """``url``: ``unix:///path``, ``redis://host:port`` or ``rediss://…``. Raises ConfigError."""
        lost = (redis.exceptions.ConnectionError,)  # one that hangs would keep the role once more
        retry = Retry(ExponentialBackoff(cap=0.1, base=0.01), retries=3, supported_errors=lost)
        if fix := fault(url):
            raise ConfigError("--redis-url", redacted(url), fix)
        try:
            if not parse_qs(urlsplit(url).query, keep_blank_values=True).keys() <= OPTIONS:
                raise ValueError
            encrypted = {"connection_class": TlsConnection} if url.startswith("rediss:") else {}
            self.redis: Any = RedisClient.from_url(  # Any: its annotations do not know decode_responses
                url, retry=retry, socket_timeout=TIMEOUT_SECONDS, **encrypted
            )
            pool = self.redis.connection_pool
            pool.connection_class(**pool.connection_kwargs)  # knows what their values may be
            if not all(0 < pool.connection_kwargs.get(name, 1) < TIMEOUT_LIMIT for name in TIMEOUTS):
                raise ValueError
        except (ValueError, TypeError, redis.exceptions.RedisError):  # whose words may quote a password
            raise ConfigError("--redis-url", redacted(url), "its options are no good; fix what follows ?") from None
        self.url, self.prefix = url, f"rmc:{run}"
        self.refused: Counter[str] = Counter()  # what roles wrote and could not be read, by reason
        self._repeat: Callable[[Callable[[], Any]], Any] | None = None
        self._rests_until = 0.0  # by the monotonic clock: a Redis that hangs is left alone for as long as it took

    def key(self, *parts: object) -> str:
        return ":".join([self.prefix, *map(str, parts)])

    @contextmanager
    def repeated(self, repeat: Callable[[Callable[[], Any]], Any]) -> Iterator[None]:
        """Within it ``repeat`` makes every call, perhaps again: not for ``commit``, which trims a full Redis."""
        self._repeat = repeat
        try:
            yield
        finally:
            self._repeat = None

    def call(self, action: Callable[..., T], *args: Any) -> T:
        """What the action gives. Raises BusUnavailable, BusFull, and ConfigError for an answer that does not pass."""
        if self._repeat is None:
            return self._call_once(action, *args)
        answer: T = self._repeat(partial(self._call_once, action, *args))
        return answer

    def _call_once(self, action: Callable[..., T], *args: Any) -> T:
        if time.monotonic() < self._rests_until:
            raise BusUnavailable("Redis did not answer in time")
        try:
            return action(*args)
        except redis.exceptions.ResponseError as error:
            refused = refusal(error, self.url)
            if isinstance(refused, BusUnavailable):  # a failover may have led the name to another server
                self.redis.connection_pool.disconnect()
            raise refused from None
        except redis.exceptions.TimeoutError as error:
            self._rests_until = time.monotonic() + TIMEOUT_SECONDS  # half of the time is for what needs no Redis
            raise BusUnavailable(str(error)) from None
        except redis.exceptions.InvalidResponse:  # whose words are the other end's
            self.redis.connection_pool.disconnect()
            raise BusUnavailable("what answers is no Redis") from None
        except UnicodeError:
            raise BusUnavailable("its host has an impossible name") from None
        except (redis.exceptions.ConnectionError, OSError) as error:
            raise BusUnavailable(str(error)) from None

    def ping(self) -> None:
        """Raises BusUnavailable where no Redis answers, or one that will not have us."""
        try:
            self.call(self.redis.ping)
        except ConfigError as error:  # a Redis that knows no login repeats it
            password = self.redis.connection_pool.connection_kwargs.get("password")
            raise BusUnavailable(error.fix.replace(password or HIDDEN, HIDDEN)) from None

    def integers(self, raw: bytes | None, count: int) -> list[int] | None:
        """So many numbers, as they stand in a value; None where there is no value, or another one, which is counted."""
        words = (raw or b"").split()
        if len(words) == count and all(INTEGER.fullmatch(word) for word in words):
            return [int(word) for word in words]
        self.refused["control"] += bool(raw)
        return None

    def number(self, raw: bytes | None) -> int:
        """A number as it stands in a value; 0 where there is none."""
        return (self.integers(raw, 1) or [0])[0]

    def each(self, command: str, keys: list[str], *words: object) -> list[Any]:
        """The same command for each key in one round trip; the replies stay apart."""
        pipe = self.redis.pipeline(transaction=False)
        for key in keys:
            pipe.execute_command(command, key, *words)
        replies: list[Any] = self.call(pipe.execute)
        return replies
