"""What the parser says of words that it cannot read."""


def as_line(boxed: str) -> str:
    """tyro's boxed message as one line, without its frame, headings and help text."""
    rows = [row.strip("│╭╮╰╯─ \t") for row in boxed.splitlines()]
    body = [row for row in rows if row.strip("-")]
    ends = [i for i, row in enumerate(body) if row.startswith(("For full helptext", "Argument helptext"))]
    heading = 1 if len(body) > 1 else 0
    return " ".join(body[heading : ends[0] if ends else None])
