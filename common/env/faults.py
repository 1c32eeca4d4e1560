"""What a user's environment does wrong, in one line that names the place in their own file."""

import sysconfig
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

from rmc.common.errors import EnvFault, RmcError, one_line

PASSED_ON = (
    KeyboardInterrupt,
    GeneratorExit,
)  # nobody's fault; all else is theirs, also a call of sys.exit and a Rust library's panic
INSTALLED = {"site-packages", "dist-packages"}
STANDARD_LIBRARY = sysconfig.get_path("stdlib")
ResultT = TypeVar("ResultT")


def call_env(what: str, call: Callable[..., ResultT], *arguments: Any) -> ResultT:
    """What a method of the environment's gives. Raises EnvFault with the error's place where it raises."""
    try:
        return call(*arguments)
    except (RmcError, *PASSED_ON):
        raise
    except BaseException as error:
        raise EnvFault(f"the environment's {what} raises {describe_error(error)}") from error


def describe_error(error: BaseException) -> str:
    """An error of a user's code in a line, with the innermost place in a file of theirs, if there is any."""
    while error.__cause__ is not None and not _users_places(error):  # gymnasium raises some errors anew
        error = error.__cause__
    text, places = one_line(error), _users_places(error)
    if isinstance(error, EnvFault):  # it has its place already
        return text
    name = f"{type(error).__name__}: {text}" if text else type(error).__name__
    return name if isinstance(error, SyntaxError) or not places else f"{name} ({places[-1]})"


def _users_places(error: BaseException) -> list[str]:
    """File and line of each frame in a file of theirs, the innermost last; without any, in an installed package's."""
    frames = [(frame, line) for frame, line in traceback.walk_tb(error.__traceback__) if not _is_ours(frame)]
    users = [(frame, line) for frame, line in frames if not _is_installed(frame)]
    return [f"{Path(frame.f_code.co_filename).name}, line {line}" for frame, line in users or frames]


def _is_ours(frame: FrameType) -> bool:
    """Whether it is RMC's, gymnasium's or Python's."""
    module, file = frame.f_globals.get("__name__", ""), frame.f_code.co_filename
    of_python = file.startswith(("<frozen", f"{STANDARD_LIBRARY}/")) and not _is_installed(frame)
    return of_python or module.partition(".")[0] in ("rmc", "gymnasium")


def _is_installed(frame: FrameType) -> bool:
    return bool(INSTALLED & set(Path(frame.f_code.co_filename).parts))
