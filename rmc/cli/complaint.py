"""What the parser says of words that it cannot read."""

import re

ENDS = ("For full helptext", "Argument helptext", "Arguments are applied", "Perhaps you meant")
# The frame is of spaces where the output is no UTF-8.
NEAR = re.compile(r"[│ ] {5}(--?[\w-]+)")
WHERE = re.compile(r"[│ ] {9}in (rmc [\w -]+?) --help")


def as_line(boxed: str, command: str) -> str:
    """tyro's boxed message as one line, without its frame, headings and help text.

    Of the options that it finds near, the first of the ``command``, like rmc train, is named; or whose it is.
    """
    rows = [row.strip("│╭╮╰╯─ \t") for row in boxed.splitlines()]
    body = [row for row in rows if row.strip("-")]
    ends = [i for i, row in enumerate(body) if row.startswith(ENDS)]
    heading = 1 if len(body) > 1 else 0
    message = " ".join(body[heading : ends[0] if ends else None])
    return re.sub(r" \(applied to rmc[\w -]*\)", "", message) + _near(boxed, command)


def _near(boxed: str, command: str) -> str:
    near: dict[str, list[str]] = {}
    for row in boxed.splitlines():
        if option := NEAR.match(row):
            near[option[1]] = []
        elif near and (where := WHERE.match(row)):
            near[list(near)[-1]].append(where[1])
    for name, commands in near.items():
        if command in commands:
            return f"; did you mean {name}?"
    return "".join(f"; {name} is an option of {commands[0]}" for name, commands in near.items() if commands)
