"""The origin time of a fix: when the target emitted, as columns of tables and as text."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np

from optloc.base.types import Array
from optloc.show.columns import Columns

# Numbers that a date of Python can hold, seconds since 1970: the years 1 to 9999.
_FIRST, _LAST = -62_135_596_800.0, 253_402_300_799.0


def origin_columns(seconds: Array, sigma: Array, dated: bool) -> Columns:
    """Return the columns of emission times: `emission_s`, `sigma_emission_s` and, for dates, `emission_time`.

    Parameters
    ----------
    seconds, sigma : array (n,)
        Emission times on the clock of the arrivals, and their standard deviations, seconds; NaN without a fix.
    dated : bool
        Whether the times are seconds since 1970, UTC; `emission_time` is then the date as ISO 8601 text.
    """
    columns: Columns = {"emission_s": seconds, "sigma_emission_s": sigma}
    if dated:
        texts = [iso_of(*pair) for pair in zip(seconds.tolist(), sigma.tolist(), strict=True)]
        columns["emission_time"] = np.array(texts, dtype=object)
    return columns


def iso_of(seconds: float, sigma: float) -> str:
    """Return seconds since 1970 as ISO 8601 text in UTC; empty for NaN.

    The last digit is of the size of the standard deviation, at most microseconds.
    """
    if not _FIRST <= seconds <= _LAST:
        return ""
    digits = _digits(sigma, 6)
    whole = round(seconds * 10**6 / 10 ** (6 - digits)) * 10 ** (6 - digits)
    when = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=whole)
    text = when.strftime("%Y-%m-%dT%H:%M:%S").zfill(19)
    return text + (f".{when.microsecond:06d}"[: digits + 1] if digits else "") + "Z"


def origin_text(columns: Columns, row: int) -> str:
    """Return the emission time of a row of a table with its standard deviation, as text; empty without one."""
    if "emission_s" not in columns or not np.isfinite(columns["emission_s"][row]):
        return ""
    seconds, sigma = float(columns["emission_s"][row]), float(columns["sigma_emission_s"][row])
    spread = f" ± {sigma:.2g}" if np.isfinite(sigma) else ""
    if "emission_time" in columns and columns["emission_time"][row]:
        return f"{columns['emission_time'][row]}{spread}{' s' if spread else ''}"
    return f"{seconds:.{_digits(sigma, 12)}f}{spread} s"


def _digits(sigma: float, most: int) -> int:
    """Return the number of decimals that show two digits of a standard deviation, at most `most`."""
    if not sigma > 0.0 or not np.isfinite(sigma):
        return min(6, most)
    return int(np.clip(1 - np.floor(np.log10(sigma)), 0, most))
