"""Ranges to a target above the plane are slant ranges."""

import numpy as np
from advice.cases import PLACES, TRUTHS, range_case

from optloc.advice.causes import causes_of

FLAT = np.linalg.norm(TRUTHS[:2, None] - PLACES, axis=-1)


def test_slant_ranges_need_a_height():
    first = causes_of(range_case(np.hypot(FLAT, 2500.0) - FLAT, epochs=2)[0])[0]
    assert first.change.cause == "height"
