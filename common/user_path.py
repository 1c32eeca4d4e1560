"""Paths as people write them."""

import os
from pathlib import Path

from rmc.common.errors import ConfigError


def user_path(path: str | Path) -> Path:
    """A path whose ``~`` is a home, also where no shell has seen it; a user whom there is none of stays as written.

    Raises ConfigError for what is no path.
    """
    try:
        return Path(os.path.expanduser(path))
    except TypeError:
        raise ConfigError("path", path, "take text or a Path") from None
