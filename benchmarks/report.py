"""The newest result of each name as a table in docs/performance.md, between its two marks.

python -m benchmarks.report
"""

import json
from typing import Any

from benchmarks.harness import HERE

PAGE = HERE.parent / "docs" / "performance.md"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
HEAD = "| what | ours | compared with | ratio | ceiling in the same run | day |\n|---|---|---|---|---|---|\n"


def newest() -> list[dict[str, Any]]:
    """Of each name and peer the last row, in the order of the names."""
    last: dict[tuple[str, str], dict[str, Any]] = {}
    for path in sorted((HERE / "results").glob("[0-9]*.json")):
        for row in json.loads(path.read_text()):
            last[row["name"], row["peer"]] = {**row, "day": path.stem}
    return [last[key] for key in sorted(last)]


def number(value: float) -> str:
    """Four digits that matter."""
    return f"{value:,.0f}".replace(",", " ") if abs(value) >= 1000 else f"{value:.4g}"


def _range(row: dict[str, Any], of: str, value: float) -> str:
    least, largest = row["spread"].get(of, (value, value))
    if least == largest:
        return number(value)
    return f"{number(value)} ({number(least)} to {'never' if largest is None else number(largest)})"


def line(row: dict[str, Any]) -> str:
    """One row of the table."""
    peer, value, ratio, limit = row["peer"], row["peer_value"], row["ratio"], row["limit"]
    if peer:
        peer = f"{peer}: " + ("not installed" if value is None else _range(row, "peer", value))
    ceiling = "" if limit is None else f"{row['limit_is']}: {_range(row, 'limit', limit)}"
    if limit and row["unit"].endswith("/s"):
        ceiling += f"; ours is {100 * row['ours'] / limit:.1f} %"
    better = "" if ratio is None else f"{ratio:.2f}"
    ours = f"{_range(row, 'ours', row['ours'])} {row['unit']}"
    return f"| {row['name']} | {ours} | {peer} | {better} | {ceiling} | {row['day']} |"


def main() -> None:
    text = PAGE.read_text()
    before, rest = text.split(BEGIN)
    after = rest.split(END)[1]
    table = HEAD + "\n".join(line(row) for row in newest())
    PAGE.write_text(f"{before}{BEGIN}\n{table}\n{END}{after}")


if __name__ == "__main__":
    main()
