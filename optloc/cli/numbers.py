"""Numbers as people read them."""

from __future__ import annotations

import numpy as np


def with_sigma(value: float, sigma: float, unit: str) -> str:
    """Return a number with its standard deviation, rounded to it; a constraint may leave it none."""
    unit = unit if unit != "1" else ""
    if sigma <= 1e-12 * (1.0 + abs(value)):
        return f"{value:.10g} {unit} (held)"
    if not np.isfinite(sigma):
        return f"{value:.6g} {unit}"
    digits = int(max(0, 1 - np.floor(np.log10(sigma))))
    return f"{value:.{digits}f} ± {sigma:.{digits}f} {unit}"
