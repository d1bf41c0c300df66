"""Origin times as columns and as text."""

import numpy as np
import pytest

from optloc.show.origin_time import iso_of, origin_columns, origin_text


@pytest.mark.parametrize(
    ("seconds", "sigma", "text"),
    [
        (1714557611.975, 0.097, "2024-05-01T10:00:11.975Z"),
        (1714557611.975, 0.5, "2024-05-01T10:00:11.98Z"),
        (1714557611.975, 30.0, "2024-05-01T10:00:12Z"),
        (1714557611.999999, 0.05, "2024-05-01T10:00:12.000Z"),
        (-1.5, 0.01, "1969-12-31T23:59:58.500Z"),
        (1714557611.975, np.nan, "2024-05-01T10:00:11.975000Z"),
        (np.nan, 0.1, ""),
        (1e300, 0.1, ""),
    ],
)
def test_dates_have_the_digits_of_their_sigma(seconds, sigma, text):
    assert iso_of(seconds, sigma) == text


def test_rows_have_their_text():
    numbers = origin_columns(np.array([12.1374, np.nan]), np.array([0.042, np.nan]), False)
    assert list(numbers) == ["emission_s", "sigma_emission_s"]
    assert origin_text(numbers, 0) == "12.137 ± 0.042 s"
    assert origin_text(numbers, 1) == ""
    assert origin_text({}, 0) == ""
    dates = origin_columns(np.array([1714557611.975]), np.array([0.097]), True)
    assert origin_text(dates, 0) == "2024-05-01T10:00:11.975Z ± 0.097 s"
