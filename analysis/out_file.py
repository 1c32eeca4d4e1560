"""Where a command writes a picture, a video or a model: judged before the work begins."""

from pathlib import Path

from rmc.common.errors import ConfigError
from rmc.common.whole_file import temporary_path

PICTURES, NUMBERS = (".png", ".pdf", ".svg", ".jpg"), ".jsonl"


def check_writable(name: str, path: Path, suffixes: tuple[str, ...]) -> None:
    """Raises ConfigError where a file of one of these kinds cannot be written there; tries, and changes nothing."""
    if not path.parent.is_dir():
        raise ConfigError(name, str(path), "its folder is not there; make it, or give another")
    if path.is_dir():
        raise ConfigError(name, str(path), f"is a folder; give a file in it, like {path / f'out{suffixes[0]}'}")
    if path.suffix.lower() not in suffixes:
        raise ConfigError(name, str(path), f"give a name that ends in {' or '.join(suffixes)}")
    try:
        for one in (path, temporary_path(path)):  # it is whole before it has its name
            there = one.exists()
            one.open("ab").close()
            if not there:
                one.resolve().unlink()  # of a link, what it leads to
    except OSError as error:
        raise ConfigError(name, str(path), f"cannot be written ({error.strerror}); give another") from None
