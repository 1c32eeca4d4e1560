"""Paths as people write them."""

import os
from pathlib import Path


def user_path(path: str | Path) -> Path:
    """A path whose ``~`` is a home, also where no shell has seen it; a user whom there is none of stays as written."""
    return Path(os.path.expanduser(path))
