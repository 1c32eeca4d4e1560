"""The short form of ``fuzz.py``."""

from tests.faults.fuzz import KINDS, TAKEN, fuzz


def test_changed_messages_are_taken_or_refused_by_name():
    row = fuzz(20_000, seed=1)
    assert row.passed, row
    for kind in KINDS.keys() - {"counters"}:  # of which a damaged one is as none at all
        assert any(name.startswith(f"{kind}: ") and not name.endswith(TAKEN) for name in row.found), kind
