"""The short form of ``fuzz.py``."""

from tests.faults.fuzz import KINDS, fuzz


def test_changed_messages_are_taken_or_refused_by_name():
    row = fuzz(20_000, seed=1)
    assert row.passed, row
    for kind in KINDS:
        assert any(name.startswith(kind) for name in row.found) or kind == "counters", kind
