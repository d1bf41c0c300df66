"""What a verdict says beside `ok`: for tests of methods that find the one place and cannot prove that it is."""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array, Status
from optloc.problem.fix import Fix

AGAINST = (Status.MISFIT, Status.UNBOUNDED, Status.AMBIGUOUS, Status.CONTRADICTORY)
"""What speaks against a place, or for another one; a missing proof and a covariance that does not cover do not."""


def alone(fix: Fix) -> Array:
    """Return where one place was found and nothing speaks against it, proven or not, (...)."""
    return np.asarray(fix.answered & ~fix.has(*AGAINST))
