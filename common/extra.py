"""What the package does not need by itself: how a user installs it."""

import importlib.util
from pathlib import Path

from rmc.common.errors import ConfigError


def how_to_install(extra: str) -> str:
    """The command for an extra of pyproject.toml. PyPI's ``rmc`` is another project, ours is ``rmc-rl``."""
    package = importlib.util.find_spec("rmc")  # not imported: this is a layer below it
    assert package is not None
    assert package.origin is not None
    above = Path(package.origin).parents[1]
    if (above / "pyproject.toml").exists():  # a checkout; a wheel's files lie in site-packages
        return f"pip install -e '.[{extra}]' in {above}"
    return f"pip install 'rmc-rl[{extra}]'"


def check_installed(extra: str, packages: tuple[str, ...], field: str, value: object) -> None:
    """Raises ConfigError, which names ``field`` and ``value``, where a package of an extra is missing."""
    for package in packages:
        if importlib.util.find_spec(package) is None:
            raise ConfigError(field, value, f"{package.replace('_', '-')} is missing; {how_to_install(extra)}")
