"""Rates that are shown."""

import pytest

from rmc.common import metrics
from rmc.common.metrics import Rate


def test_a_rate_is_over_ten_seconds_and_so_does_not_jump_with_bursts(monkeypatch: pytest.MonkeyPatch) -> None:
    rate, shown = Rate(), []
    for second in range(40):
        monkeypatch.setattr(metrics.time, "monotonic", lambda now=float(second): now)
        shown.append(rate.take(100 * (second // 2)))  # 100 every other second
    assert shown[0] == 0.0
    assert all(value == 50.0 for value in shown[12:])


def test_a_rate_follows_a_change_within_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    rate = Rate()
    for second in range(31):
        monkeypatch.setattr(metrics.time, "monotonic", lambda now=float(second): now)
        shown = rate.take(1000 * min(second, 20))
    assert shown == 0.0
