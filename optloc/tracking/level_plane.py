"""Tracks on a horizontal plane of a frame that is not on Earth, such as the floor of a hall."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Band
from optloc.problem.problem import Problem
from optloc.tracking.updates import Update, Updated

# Standard deviation of the third coordinate after an update, m, as for an exact height on Earth.
_EXACT = 0.01


def is_level(band: Band) -> bool:
    """Return whether a constraint is a horizontal plane: the third coordinate of a target is exact."""
    normal = np.asarray(band.coefficients, dtype=float)
    level = band.kind == "plane" and normal.shape == (3,) and normal[2] == 1.0 and not normal[:2].any()
    return bool(level and np.array_equal(band.lower, band.upper))


def level_of(problem: Problem) -> float | None:
    """Return the third coordinate of the target if a constraint makes it exact, metres; else None."""
    bands = [band for band in problem.constraints if isinstance(band, Band) and is_level(band)]
    return float(bands[0].lower) if bands else None


@dataclass(frozen=True, slots=True)
class OnPlane:
    """A filter whose states are on the plane z = `level`, m: each update ends with this exact measurement."""

    rule: Update
    level: float

    def __call__(self, scan: Problem, mean: np.ndarray, cov: np.ndarray) -> Updated:
        """Return the updated state, measured to be on the plane with a standard deviation of a centimetre."""
        found = self.rule(scan, mean, cov)
        # Kalman's update by one coordinate: the gain is a column of the covariance over the innovation variance.
        column = found.cov[..., :, 2]
        variance = found.cov[..., 2, 2] + _EXACT**2
        gain = column / variance[..., None]
        moved = found.mean + gain * (self.level - found.mean[..., 2])[..., None]
        return replace(found, mean=moved, cov=found.cov - gain[..., :, None] * column[..., None, :])
