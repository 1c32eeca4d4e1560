"""No part of a password is shown, however it stands in a URL."""

import socket
from concurrent.futures import ThreadPoolExecutor

import pytest

from rmc.common.bus.redis_bus import RedisBus
from rmc.common.bus.redis_url import has_password, redacted, without_passwords
from rmc.common.errors import BusUnavailable, ConfigError

SHOWN = {
    "redis://host:6379": "redis://host:6379",
    "redis://[::1]:6379/2": "redis://[::1]:6379",
    "redis://user:hunter2@host:6379": "redis://host:6379",
    "redis://:hun@ter2@host": "redis://host",
    "rediss://host:1?password=hunter2": "rediss://host:1",
    "rediss://hunter2@host:1?ssl_ca_certs=/a&password=hunter2": "rediss://host:1",
    "rediss://host:1?ssl_certfile=/a&ssl_password=hunter2": "rediss://host:1",
    "unix://user:hunter2@/run/a.sock": "unix:///run/a.sock",
    "unix:///run/a.sock?db=1&password=hunter2": "unix:///run/a.sock",
    "unix:///home/me@lab/a.sock": "unix:///home/me@lab/a.sock",
}
UNPARSED = {
    "redis://:hunter2#x@host:6379": "redis://…",
    "redis://:hunter2/x@host:6379": "redis://…",
    "redis://:hunter2?x@host:6379": "redis://…",
    "redis://:x/hunter2@host:6379": "redis://…",
    "redis://:hunter2": "redis://…",
    "redis://user:hunter2": "redis://…",
    "redis://[hunter2@host": "redis://…",
    "redis://:hunter2@host:99999": "redis://…",
}
SUSPICIOUS = {
    "redis://:1/hunter2@host:6379": "redis://…",
    "redis://:1?hunter2@host:6379": "redis://…",
    "redis://:1#hunter2@host:6379": "redis://…",
    "unix://user:1/hunter2@/run/a.sock": "unix://…",
}
OTHERS = {"hunter2": "…", "hunter2:x@host:1": "…", "": "…", "hunter2://host": "…", "http://hunter2@host": "…"}


@pytest.mark.parametrize(("url", "expected"), [*SHOWN.items(), *UNPARSED.items(), *SUSPICIOUS.items(), *OTHERS.items()])
def test_a_url_is_shown_without_its_password(url: str, expected: str) -> None:
    assert redacted(url) == expected
    assert without_passwords(f"--redis-ulr={url}") == f"--redis-ulr={expected}" or "://" not in url


@pytest.mark.parametrize("url", [*SHOWN])
def test_a_password_is_seen(url: str) -> None:
    assert has_password(url) == ("hun" in url)


@pytest.mark.parametrize("url", [*UNPARSED, *SUSPICIOUS, *OTHERS])
def test_one_that_redis_cannot_read_is_named_without_its_parts(url: str) -> None:
    """Nor one that its client would read: it takes the password's beginning for a host or a port, and says so."""
    with pytest.raises(ConfigError, match=r"--redis-url='.*…': not a Redis URL; give unix:///path") as raised:
        RedisBus(url, "run")
    assert "hun" not in str(raised.value)
    assert raised.value.__cause__ is None


@pytest.mark.parametrize(
    ("rest", "named"),
    [
        *((path, "database") for path in ("/abc", "/1/2", "/-1")),
        *(
            (f"?{option}", "options")
            for option in (
                "db=abc",
                "nope=1",
                "socket_timeout=-1",
                "socket_connect_timeout=nan",
                "decode_responses=True",
                "encoding_errors=strict",
                "cache_config=x&protocol=3",
                "socket_keepalive_options=1",
            )
        ),
    ],
)
def test_what_its_client_would_pass_over_or_fail_of_later_is_refused(rest: str, named: str) -> None:
    with pytest.raises(ConfigError, match=rf"--redis-url='redis://host:1': its {named}"):
        RedisBus(f"redis://:hunter2@host:1{rest}", "run")


@pytest.mark.parametrize("rest", ["", "/", "/3", "?db=3", "/?socket_timeout=1.5"])
def test_a_database_may_be_named(rest: str) -> None:
    assert RedisBus(f"redis://:hunter2@host:1{rest}", "run").url.endswith(rest)


def test_a_login_that_the_other_end_repeats_is_not_shown() -> None:
    """A Redis before 6 answers so."""

    def refuse(listener: socket.socket) -> None:
        accepted, _ = listener.accept()
        with accepted:
            words = accepted.recv(4096).decode().split("\r\n")[2::2]
            accepted.sendall(f"-ERR unknown command, with args beginning with: {words}\r\n".encode())

    with socket.create_server(("127.0.0.1", 0)) as listener, ThreadPoolExecutor(1) as pool:
        pool.submit(refuse, listener)
        port = listener.getsockname()[1]
        with pytest.raises(BusUnavailable, match=r"unknown command.*…") as raised:
            RedisBus(f"redis://:hunter2@127.0.0.1:{port}", "run").ping()
    assert "hunter2" not in str(raised.value)


def test_what_is_no_redis_is_an_outage() -> None:
    """Of a web server, say; what it answers is not repeated."""

    def answer(listener: socket.socket) -> None:
        for _ in range(2):
            accepted, _ = listener.accept()
            with accepted:
                accepted.recv(4096)
                accepted.sendall(b"<html>hunter2")

    with socket.create_server(("127.0.0.1", 0)) as listener, ThreadPoolExecutor(1) as pool:
        pool.submit(answer, listener)
        bus = RedisBus(f"redis://127.0.0.1:{listener.getsockname()[1]}", "run")
        for _ in range(2):
            with pytest.raises(BusUnavailable, match="what answers is no Redis"):
                bus.ping()
    with pytest.raises(BusUnavailable, match="its host has an impossible name"):
        RedisBus("redis://redis..example.com:6379", "run").ping()


def test_a_login_without_its_scheme_is_not_repeated() -> None:
    assert without_passwords("--redis-ulr=me:hunter2@host") == "--redis-ulr=…"
