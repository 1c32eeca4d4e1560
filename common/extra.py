"""What the package does not need by itself: how a user installs it."""

from pathlib import Path

import rmc


def how_to_install(extra: str) -> str:
    """The command for an extra of pyproject.toml. PyPI's ``rmc`` is another project, ours is ``rmc-rl``."""
    above = Path(rmc.__file__).parents[1]
    if (above / "pyproject.toml").exists():  # a checkout; a wheel's files lie in site-packages
        return f"pip install -e '.[{extra}]' in {above}"
    return f"pip install 'rmc-rl[{extra}]'"
