"""A warning where a password is in a command line."""

import logging

from rmc.common.bus.redis_url import has_password, shown

log = logging.getLogger(__name__)


def warn_of_password(url: str) -> None:
    """Say that everybody on this machine can read the URL's password, if it has one."""
    if has_password(url):
        fix = "write the URL to a file that only you may read, and give --redis-url file:PATH"
        log.warning("--redis-url=%r: everybody here can read its password in ps; %s", shown(url), fix)
