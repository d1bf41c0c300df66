"""Rows of `locate` in SI units: noise, dates and coarse times."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.base.units import conversion
from optloc.files.call_rows import per_word, since_first

METRES = conversion("s", "length", propagation_speed=343.0)


def test_times_keep_their_digits():
    dates = np.array(["2024-05-01T10:00:00.000000001", "2024-05-01T10:00:00.000000003", "NaT"], dtype="datetime64[ns]")
    assert since_first(dates, 1.0, METRES)[:2] == pytest.approx([0.0, 2e-9])
    whole = np.array([1_700_000_000_000_000_001, 1_700_000_000_000_000_004])
    assert since_first(whole, 1.0, METRES).tolist() == [0.0, 3.0]
    with pytest.raises(InvalidProblem, match="too coarse"):
        since_first(np.array([1.7e18, 1.7e18]), 1e-3, METRES)


def test_values_per_argument():
    assert per_word({"p": 1.0}, "p", ["p", "s"], "sigma") == 1.0
    with pytest.raises(InvalidProblem, match="no measurements with the name"):
        per_word({"q": 1.0}, "p", ["p", "s"], "sigma")
