"""Puts the rows of tests/faults/results.json into docs/reliability.md: ``make docs``. A test sees to it."""

import json
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parent / "reliability.md"
RESULTS = Path(__file__).parents[1] / "tests" / "faults" / "results.json"
BEGIN, END = "<!-- faults -->\n", "<!-- end -->\n"
HEAD = ["| fault | tries | windows | lost | doubled | back, s | passed | found | of |", "|---" * 9 + "|"]
NONE, LONGEST_CELL = "", 200


def main() -> None:
    """Write the table."""
    PAGE.write_text(page())


def page() -> str:
    """The page with the table as it should be."""
    before, _, rest = PAGE.read_text().partition(BEGIN)
    rows = json.loads(RESULTS.read_text()) if RESULTS.exists() else []
    table = "\n".join([*HEAD, *map(_line, rows)]) + "\n"
    return before + BEGIN + table + END + rest.partition(END)[2]


def _line(row: dict[str, Any]) -> str:
    counts = (row["tries"], row["acknowledged"], row["lost"], row["duplicated"], row["recovery_s_max"])
    cells = [row["fault"], *map(_cell, counts), "yes" if row["passed"] else "**no**", _measures(row["found"])]
    return f"| {' | '.join(cells)} | {row['date']}, {row['commit']} |"


def _cell(value: float | None) -> str:
    return NONE if value is None else f"{value:,}".replace(",", " ")


def _measures(measures: dict[str, Any]) -> str:
    """What else it measured, what came to nothing left out; a long list stays where it is."""
    text = "; ".join(f"{name.replace('_', ' ')} {value}" for name, value in measures.items() if value) or NONE
    return text if len(text) <= LONGEST_CELL else f"{len(measures)} figures in `tests/faults/results.json`"


if __name__ == "__main__":
    main()
