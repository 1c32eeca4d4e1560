"""Every error that RMC raises on purpose.

RmcError
├── ConfigError          an option, file or environment the user must change (exit status 2)
├── EnvFault             a user's environment raises, or gives what it may not
├── MessageError         a message that is not what its header or the run promises
├── FencedError          a newer process has taken this role's name: end yourself
├── BusUnavailable       Redis cannot be reached, or answers that it cannot now (worth retrying)
├── BusFull              Redis is out of memory, or of disk for its log (worth waiting)
├── AuthenticationError  the other end of a socket does not know the run's secret
├── CheckpointError      a checkpoint is missing, does not match its manifest, or cannot be written
└── RoleDied             a supervised role ended too often
"""

CONFIG_STATUS = 2  # exit status of an error that starting again cannot fix
STOPPED_STATUS = 130  # after Ctrl-C, as shells have it


class RmcError(Exception):
    """Base class: catching it catches everything raised on purpose."""


class ConfigError(RmcError):
    """Something the user can change. The message is one line: option, value, fix."""

    def __init__(self, field: str, value: object, fix: str) -> None:
        shown = field if field.isprintable() else repr(field)  # a stranger's key
        super().__init__(f"{shown}={value!r}: {fix}")
        self.field, self.value, self.fix = field, value, fix

    def __reduce__(self) -> tuple[type["ConfigError"], tuple[str, object, str]]:
        """Whole across processes, where pickle would make it of its message alone."""
        return type(self), (self.field, self.value, self.fix)


class EnvFault(RmcError):
    """A user's environment raises, or gives what it may not. The message is one line, with the place in their file."""


class MessageError(RmcError):
    """A malformed message; ``reason`` is a short, countable slug, ``detail`` says the rest."""

    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(f"{reason}: {detail}" if detail else reason)
        self.reason = reason


class FencedError(RmcError):
    """A larger epoch holds this role's name; nothing more of ours will be accepted."""


class BusUnavailable(RmcError):
    """Redis cannot be reached now."""


class BusFull(RmcError):
    """Redis refuses writes: it is out of memory, or of disk for its append-only file."""


class AuthenticationError(RmcError):
    """The peer failed the mutual challenge."""


class CheckpointError(RmcError):
    """No valid checkpoint, one that does not match its manifest, or that cannot be written; ``reason``: why not."""

    def __init__(self, message: str, reason: str = "") -> None:
        super().__init__(message)
        self.reason = reason


class RoleDied(RmcError):
    """A role died more often than the supervisor restarts it."""


def one_line(error: BaseException) -> str:
    """An error's own words, without its line breaks."""
    return " ".join(str(error).split())


def first_line(error: BaseException) -> str:
    """Its message's, or its name where it has none."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def last_line(error: BaseException) -> str:
    """The same of its last: Ray puts whole tracebacks before that."""
    return (str(error).strip() or type(error).__name__).splitlines()[-1]
