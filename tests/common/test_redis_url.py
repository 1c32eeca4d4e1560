"""No part of a password is shown, however it stands in a URL."""

import pytest

from rmc.common.bus.redis_bus import RedisBus
from rmc.common.bus.redis_url import has_password, shown, without_passwords
from rmc.common.errors import ConfigError

SHOWN = {
    "redis://host:6379": "redis://host:6379",
    "redis://[::1]:6379/2": "redis://[::1]:6379",
    "redis://user:hunter2@host:6379": "redis://host:6379",
    "redis://:hun@ter2@host": "redis://host",
    "rediss://host:1?password=hunter2": "rediss://host:1",
    "rediss://hunter2@host:1?ssl_ca_certs=/a&password=hunter2": "rediss://host:1",
    "unix://user:hunter2@/run/a.sock": "unix:///run/a.sock",
    "unix:///run/a.sock?db=1&password=hunter2": "unix:///run/a.sock",
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
    assert shown(url) == expected
    assert without_passwords(f"--redis-ulr={url}") == f"--redis-ulr={expected}" or "://" not in url


@pytest.mark.parametrize("url", [*SHOWN])
def test_a_password_is_seen(url: str) -> None:
    assert has_password(url) == ("hun" in url)


@pytest.mark.parametrize("url", [*UNPARSED, *OTHERS])
def test_one_that_redis_cannot_read_is_named_without_its_parts(url: str) -> None:
    with pytest.raises(ConfigError, match=r"--redis-url='.*…': not a Redis URL; give unix:///path") as raised:
        RedisBus(url, "run")
    assert "hun" not in str(raised.value)
    assert raised.value.__cause__ is None
