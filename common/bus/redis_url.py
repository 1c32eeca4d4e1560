"""A Redis's URL as it may be shown: its user-info and its query, either of which may hold a password, are left out."""

import logging
import re
from typing import Any
from urllib.parse import SplitResult, parse_qs, urlsplit

log = logging.getLogger(__name__)
SCHEMES = ("redis", "rediss", "unix")
HIDDEN = "…"  # stands for what may hold a password
UNREADABLE = (
    "not a Redis URL; give unix:///path, redis://host:port or rediss://…; in a password, write %40 for @, %2F for /, "
    "%3F for ? and %23 for #"
)


def redacted(url: str) -> str:
    """Scheme and place; the scheme alone where the URL cannot be parsed. A word without ``://`` shows nothing."""
    scheme, separator, _ = url.partition("://")
    if not separator or scheme not in SCHEMES:
        return HIDDEN
    try:
        return f"{scheme}://{_place(urlsplit(url)) or HIDDEN}"
    except ValueError:
        return f"{scheme}://{HIDDEN}"


def _place(parts: SplitResult) -> str:
    """Host and port, or a socket's path; empty where a password's ``/``, ``?`` or ``#`` may have ended the user-info.

    Raises ValueError where the port is none.
    """
    _ = parts.port  # read for its check
    path = parts.path if parts.netloc or parts.scheme != "unix" else ""  # what begins by a path has no user-info
    if parts.fragment or "@" in path + parts.query:
        return ""
    return parts.path if parts.scheme == "unix" else parts.netloc.rpartition("@")[2]


def fault(url: str) -> str:
    """Why it is refused, where a client may read it in another way than it was meant; empty where it may not."""
    if redacted(url).endswith(HIDDEN):
        return UNREADABLE
    parts = urlsplit(url)
    if parts.scheme != "unix" and not re.fullmatch("[0-9]*", parts.path.strip("/")):
        return "its database is no number; end it by /0 to /15, or by nothing"
    return ""


def has_password(url: str) -> bool:
    """Whether it holds one, in its user-info or in its query; False where it cannot be parsed, which is told anyway."""
    try:
        parts = urlsplit(url)
    except ValueError:
        return False
    return bool(parts.password) or any(name.endswith("password") for name in parse_qs(parts.query))


def warn_of_password(url: str) -> None:
    """Say that everybody on this machine can read the URL's password in a command line, if it has one."""
    if has_password(url):
        fix = "write the URL to a file that only you may read, and give --redis-url file:PATH"
        log.warning("--redis-url=%r: everybody here can read its password in ps; %s", redacted(url), fix)


def without_passwords(word: str) -> str:
    """A word of a command line, the URL or the login that it may end with as it may be shown."""
    return re.sub(r"[\w+.-]*://.*|[^=]*@.*", lambda match: redacted(match[0]), word, flags=re.DOTALL)


def value_without_passwords(value: Any) -> Any:
    """The same of a value out of a file, which may be a list."""
    if isinstance(value, list):
        return [value_without_passwords(one) for one in value]
    return without_passwords(value) if isinstance(value, str) else value
