"""What the values that travel refuse."""

import numpy as np
import pytest

from pnv_core import Frame
from pnv_core.errors import PnvError

PIXELS = np.zeros((16, 16, 3), np.uint8)


@pytest.mark.parametrize("stamp", [0.5, 1e18, "7", True, None, 2**63, -(2**63) - 1, np.float64(3)])
def test_a_stamp_that_is_no_whole_number_of_nanoseconds_is_refused(stamp):
    with pytest.raises(PnvError, match="stamp_ns = .*; allowed: a whole number of nanoseconds"):
        Frame(stamp, "front", PIXELS)


@pytest.mark.parametrize("stamp", [0, -1, 1_700_000_000_123_456_789, np.int64(5), np.uint32(5)])
def test_a_stamp_is_kept_to_the_nanosecond(stamp):
    frame = Frame(stamp, "front", PIXELS)
    assert frame.stamp_ns == stamp
    assert type(frame.stamp_ns) is int  # not numpy's: it goes into JSON and messages
