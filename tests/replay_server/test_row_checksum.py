"""A row's checksum: whatever bit of it changes, it is seen, and it alone is left out."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rmc.common.row_checksum import add_checksums, whole_rows
from rmc.common.window import WindowSpec
from tests.replay_server.support import SPEC, make_rows

ALL = WindowSpec(obs_dim=3, action_dim=2, state=4, burn_in=2, train=4, missing=3, privileged=2)


@given(st.integers(0, 12), st.sampled_from([SPEC, ALL]), st.data())
def test_every_changed_bit_is_seen(count: int, spec: WindowSpec, data: st.DataObject) -> None:
    rows = make_rows(count, spec=spec)
    add_checksums(rows)
    assert whole_rows(rows).tolist() == [True] * count
    damaged = data.draw(st.sets(st.integers(0, count - 1)) if count else st.just(set()))
    raw = rows.view(np.uint8).reshape(count, spec.dtype.itemsize)
    for row in damaged:
        bit = data.draw(st.integers(0, 8 * spec.dtype.itemsize - 1))
        raw[row, bit // 8] ^= 1 << bit % 8
    assert whole_rows(rows).tolist() == [row not in damaged for row in range(count)]


def test_rows_of_zeros_or_ones_are_none() -> None:
    rows = np.zeros(4, SPEC.dtype)
    assert not whole_rows(rows).any()
    rows.view(np.uint8)[:] = 255
    assert not whole_rows(rows).any()
