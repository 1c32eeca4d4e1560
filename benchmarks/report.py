"""The newest result of each name as a table in docs/performance.md, between its two marks.

python -m benchmarks.report
"""

import json
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
PAGE = HERE.parent / "docs" / "performance.md"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
HEAD = (
    "| what | ours | beside it, and how many times as good ours is | of the ceiling in the same run | day |\n"
    "|---|---|---|---|---|\n"
)


def newest() -> dict[str, list[dict[str, Any]]]:
    """By name the newest day's rows, one a peer; how it grows has a table of its own."""
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for path in sorted((HERE / "results").glob("[0-9]*.json")):
        for row in json.loads(path.read_text()):
            rows[row["name"], row["peer"]] = {**row, "day": path.stem}
    by_name: dict[str, list[dict[str, Any]]] = {}
    for name, peer in sorted(rows):
        if not name.startswith("growth"):
            by_name.setdefault(name, []).append(rows[name, peer])
    last_day = {name: max(row["day"] for row in own) for name, own in by_name.items()}
    return {name: [row for row in own if row["day"] == last_day[name]] for name, own in by_name.items()}


def number(value: float) -> str:
    """Four digits that matter."""
    return f"{value:,.0f}".replace(",", " ") if abs(value) >= 1000 else f"{value:.4g}"


def _range(row: dict[str, Any], of: str, value: float) -> str:
    least, largest = row["spread"].get(of, (value, value))
    if least == largest:
        return number(value)
    return f"{number(value)} ({number(least)} to {'never' if largest is None else number(largest)})"


def _beside(row: dict[str, Any]) -> str:
    if row["peer_value"] is None:
        return f"{row['peer']}: " + ("not reached" if "peer" in row["spread"] else "not installed")
    ratio = "" if row["ratio"] is None else f", **{row['ratio']:.2f}**"
    return f"{row['peer']} {_range(row, 'peer', row['peer_value'])}{ratio}"


def _ceiling(row: dict[str, Any]) -> str:
    if row["limit"] is None:
        return ""
    value = f"{row['limit_is']} {_range(row, 'limit', row['limit'])}"
    return f"{100 * row['ours'] / row['limit']:.0f} % of {value}" if row["unit"].endswith("/s") else value


def line(rows: list[dict[str, Any]]) -> str:
    """One line of the table: a measurement with all its peers."""
    first = rows[0]
    ours = f"{_range(first, 'ours', first['ours'])} {first['unit']}"
    beside = "; ".join(_beside(row) for row in rows if row["peer"])
    return f"| {first['name']} | {ours} | {beside} | {_ceiling(first)} | {first['day']} |"


def table() -> str:
    """All of it, between its two marks."""
    return f"{BEGIN}\n{HEAD}" + "\n".join(map(line, newest().values())) + f"\n{END}"


def main() -> None:
    text = PAGE.read_text()
    before, after = text.partition(BEGIN)[0], text.partition(END)[2]
    PAGE.write_text(before + table() + after)


if __name__ == "__main__":
    main()
