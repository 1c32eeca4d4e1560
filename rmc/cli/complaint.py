"""What the parser says of words that it cannot read."""

import contextlib
import io
import itertools
import re
from collections.abc import Sequence

from rmc.cli import config_file
from rmc.cli.parser import COMMANDS, option_names, parse
from rmc.common.errors import ConfigError
from rmc.deploy.run.option_names import did_you_mean, flag, option

SAYS_ON_OR_OFF = re.compile("true|false|yes|no|on|off", re.IGNORECASE)
ENDS = ("For full helptext", "Argument helptext", "Arguments are applied", "Perhaps you meant", "Available subcommands")


def about(words: Sequence[str], named: Sequence[str]) -> str:
    """What is wrong with words that cannot be parsed, in a line that quotes them; ``named`` begin with the command."""
    message = as_line(_boxed(words), named)
    file = config_file.named(words) if words[:1] == ["train"] else None
    of_file = file is not None and not _boxed(config_file.without_file(words))
    return f"{config_file.OPTION} {file}: {message}" if of_file else message


def _boxed(words: Sequence[str]) -> str:
    """What tyro prints of them; nothing where they can be parsed."""
    plain = contextlib.redirect_stdout(io.StringIO())  # where it is a terminal, tyro has colours for both
    with plain, contextlib.redirect_stderr(io.StringIO()) as stderr, contextlib.suppress(SystemExit, ConfigError):
        parse(list(words))
    return stderr.getvalue()


def as_line(boxed: str, words: Sequence[str]) -> str:
    """tyro's boxed message as one line, without its frame, headings and help text; and what ``words`` may mean."""
    rows = [row.strip("│╭╮╰╯─ \t") for row in boxed.splitlines()]  # the frame is of spaces where the output is no UTF-8
    body = [row for row in rows if row.strip("-")]
    ends = [i for i, row in enumerate(body) if row.startswith(ENDS)]
    heading = 1 if len(body) > 1 else 0
    message = " ".join(body[heading : ends[0] if ends else None])
    message = re.sub(r" \(applied to rmc[\w -]*\)", "", message)
    return message + (_switch(message, words) or _near(words))


def _switch(message: str, words: Sequence[str]) -> str:
    """Of an option that takes no value, and was given one that says on or off; else nothing."""
    for word, after in itertools.zip_longest(words, words[1:], fillvalue=""):
        said, equals, value = word.partition("=")
        value = value if equals else after
        if said.startswith("--") and SAYS_ON_OR_OFF.fullmatch(value) and message == f"Unrecognized options: {value}":
            name = said.removeprefix("--").removeprefix("no-")
            return f"; write --{name} or --no-{name}, without a value"
    return ""


def _near(words: Sequence[str]) -> str:
    """Of the first word that is wrong: a command or an option like it, or whose option it is; else nothing."""
    options = {name: list(map(option, option_names(kind))) for name, (kind, _) in COMMANDS.items()}
    options["train"].append("--config")
    options["sweep"] += options["train"]
    command, *rest = words or [""]
    if command not in options:
        return did_you_mean(command, options)
    for name in [flag(word) for word in rest if word.startswith("--")]:
        if name.replace("--no-", "--", 1) in options[command]:
            continue
        others = [f"rmc {other}" for other, known in options.items() if name in known and other != "role"]
        return f"; {name} is an option of {others[0]}" if others else did_you_mean(name, options[command])
    return ""
