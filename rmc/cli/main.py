"""``rmc``: every command's entry, and how errors reach the user: one line, exit status 2 for what they gave, else 1."""

import contextlib
import errno
import io
import logging
import os
import pkgutil
import sys

from rmc.common.errors import CONFIG_STATUS, STOPPED_STATUS, ConfigError, RmcError
from rmc.common.process import descendants, watchdog
from rmc.common.process.parent_death import PARENT_VARIABLE, exit_with_parent
from rmc.common.whole_file import NO_ROOM
from rmc.deploy.local.role_environment import SINGLE_THREAD
from rmc.deploy.monitor import output
from rmc.deploy.run.launch_options import PATH_VARIABLE

SINGLE_THREADED = {"actor", "replay", "evaluator"}
PLAYS = {"train", "resume", "sweep", "baseline", "check-env", "evaluate", "inspect", "report", "role"}  # environments
SHARED_MEMORY = "/dev/shm"
UNREADABLE = {  # of a path that a user has given
    errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EROFS, errno.ENAMETOOLONG, errno.ELOOP,
}  # fmt: skip
FAILED_STATUS = 1


def main() -> None:
    """The entry point.

    Leaves without Python's own clearing up: all is closed by then, and with torch loaded that takes seconds,
    which a user waits for after Ctrl-C.
    """
    output.take_over()
    descendants.spare_children()
    watchdog.start()
    try:
        status = run(sys.argv[1:])
    finally:
        descendants.end_children()
    logging.shutdown()
    os._exit(status or _unwritten())


def _unwritten() -> int:
    """The exit status of a command whose words were lost; a run has its result, and whoever ends a pipe knows of it."""
    failure = getattr(sys.stdout, "failure", "")
    if not failure or output.Output.log is not None or failure == os.strerror(errno.EPIPE):
        return 0
    return _complain(f"standard output: {failure}", FAILED_STATUS)


def run(words: list[str]) -> int:
    """Run one command; its exit status."""
    if words == ["--version"]:
        return _say_version()
    parent = os.environ.pop(PARENT_VARIABLE, None)
    _prepare_process(words, parent)
    if not _extend_import_path() and parent is None:  # a role is given whole paths
        return _complain("the working folder is gone; cd to one that is there", CONFIG_STATUS)
    try:
        return _parse_and_run(words)
    except ConfigError as error:
        return _complain(str(error), CONFIG_STATUS)
    except KeyboardInterrupt:  # before the command took the signal over
        return STOPPED_STATUS
    except SystemExit as ended:  # of a role that was ended before it began
        if not isinstance(ended.code, int):
            raise
        return ended.code
    except RmcError as error:
        if words[0] == "role":
            raise  # the supervisor shows its traceback
        return _complain(str(error), FAILED_STATUS)
    except OSError as error:
        if error.errno in NO_ROOM:
            return _complain(f"{error.filename or 'disk'}: {error.strerror}; make room and try again", FAILED_STATUS)
        begun = words[0] == "role" or output.Output.log is not None
        if begun or error.errno not in UNREADABLE or not isinstance(error.filename, str | bytes):
            raise
        return _complain(f"{os.fsdecode(error.filename)}: {error.strerror}; give another, or its rights", CONFIG_STATUS)


def _prepare_process(words: list[str], parent: str | None) -> None:
    """What numpy and torch read once, as they are imported, and the rest. ``parent``: what a role ends with."""
    if parent is not None:  # before the slow imports, so that there is no time in which a role could be left behind
        exit_with_parent(int(parent))
    if parent is not None or (words and words[0] in PLAYS):
        descendants.adopt_orphans()  # of what environments start
        if words[0] != "role":  # which ends them itself
            from rmc.cli import signals

            signals.interrupt()
    if words[:1] == ["role"] and SINGLE_THREADED.intersection(words[1:2]):
        for name, value in SINGLE_THREAD.items():
            os.environ.setdefault(name, value)
    _choose_temporary_folder()
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # spinning threads starve the other roles: 100 times slower


def _extend_import_path() -> bool:
    """By where a user's own environments are, last, so that they cannot shadow ours; False: that folder is gone."""
    try:
        own = [os.getcwd(), *filter(None, [os.environ.get(PATH_VARIABLE)])]
    except FileNotFoundError:
        return False
    sys.path += [folder for folder in own if folder not in sys.path]
    return True


def _choose_temporary_folder() -> None:
    """Shared memory where no usual place can be written, as in a container: Python would take the working folder."""
    usual = [*filter(None, map(os.environ.get, ("TMPDIR", "TEMP", "TMP"))), "/tmp", "/var/tmp", "/usr/tmp"]
    if not any(os.access(place, os.W_OK | os.X_OK) for place in usual) and os.access(SHARED_MEMORY, os.W_OK | os.X_OK):
        os.environ["TMPDIR"] = SHARED_MEMORY


def _say_version() -> int:
    """Without the slow imports."""
    from importlib.metadata import version

    sys.stdout.write(f"rmc {version('rmc-rl')}\n")
    return 0


def _parse_and_run(words: list[str]) -> int:
    if os.environ.get("NO_COLOR"):
        os.environ["PYTHON_TYRO_ANSI_CODES"] = "False"  # read when tyro is imported
    from rmc.cli import parser
    from rmc.cli.config_file import option_values
    from rmc.common.bus.redis_url import warn_of_password, without_passwords
    from rmc.deploy.local.role_environment import SECRET_VARIABLE, URL_VARIABLE

    if words[:1] != ["role"]:  # they are a role's alone: no environment, and nothing that it starts, is to inherit them
        for name in (SECRET_VARIABLE, URL_VARIABLE):
            os.environ.pop(name, None)

    words = parser.renamed(words)
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            command = parser.parse(words)
    except SystemExit as ending:
        if not ending.code:  # --help
            return 0
        return _complain(_complaint([without_passwords(word) for word in words]), CONFIG_STATUS)
    for url in option_values("--redis-url", words):  # one in a file is not seen in ps
        warn_of_password(url)
    status: int = pkgutil.resolve_name(f"rmc.cli.{parser.ACTIONS[type(command)]}")(command)
    return status


def _complaint(words: list[str]) -> str:
    """What is wrong with words that cannot be parsed; it quotes them."""
    from rmc.cli import complaint, parser

    known = [word for word in words[:1] if word in parser.COMMANDS]
    all_options = "-all" * (known in (["train"], ["resume"]))
    return f"{complaint.about(words, words)} (see {' '.join(['rmc', *known])} --help{all_options})"


def _complain(message: str, status: int) -> int:
    sys.stderr.write(f"rmc: {message}\n")
    return status


if __name__ == "__main__":
    main()
