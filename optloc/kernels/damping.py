"""When a damped step of Gauss and Newton is taken, and when it was the last: one rule, for arrays and for lanes.

Levenberg's method with Marquardt's scaling. A step is taken where it does not raise the cost by more than rounding
explains. The damping follows the ratio of the achieved decrease to that of the linear model: it falls continuously
where they agree, and grows faster and faster where steps are refused. A fix is finished when its next step is shorter
than a share of its own standard deviations, and stuck when no damping helps.

References
----------
H. B. Nielsen, "Damping parameter in Marquardt's method", IMM-REP-1999-05, Technical University of Denmark (1999).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled

FIRST_DAMPING = 1e-6
"""Starts are closed forms near the minimum, where steps should be those of Gauss and Newton (Nielsen's tau)."""
FIRST_GROWTH = 2.0
"""Factor of the damping when a step is refused; each further refusal doubles it (Nielsen's nu)."""

# Rounding of a cost, relative to one more than it: 450 units in the last place, for sums of some hundred squares.
_ROUNDING = 1e-13
# The damping must not become zero, from which no factor leads back; here a step is undamped but for its last digits.
_LEAST = 1e-12
# The inverse of the least: a step so much shorter than that of Gauss and Newton moves nothing but last digits.
_MOST = 1e12
# Nielsen's limits of one change: no more than to a third, but to a tenth where the linear model holds to 10 %.
_FALL, _QUICK_FALL, _AGREED = 1.0 / 3.0, 0.1, 0.9


class StopRules(NamedTuple):
    """When a refinement ends; see `optloc.kernels.least_squares.refine`, whose defaults these are."""

    tolerance: float = 1e-7
    limit: int = 60
    damped: bool = True


class Judged(NamedTuple):
    """What becomes of a step: each an array (N,), or a scalar.

    Parameters
    ----------
    better : bool
        Whether it is taken.
    small : bool
        Whether it was the last: the fix is finished.
    stuck : bool
        Whether it was refused and no damping helps.
    damping, growth : float
        For the next step.
    """

    better: Array
    small: Array
    stuck: Array
    damping: Array
    growth: Array


def judge(
    cost: Array,
    after: Array,
    gain: Array,
    solvable: Array,
    blur: Array,
    damping: Array,
    growth: Array,
    tolerance: float,
    damped: bool,
) -> Judged:
    """Judge a step of each of N fixes.

    Parameters
    ----------
    cost, after : array (N,)
        Before the step and behind it.
    gain : array (N,)
        Step times right-hand side: its squared length in its own standard deviations, but for the damping.
    solvable : bool array (N,)
        Whether the normal equations have a solution.
    blur : array (N,)
        Rounding error of the whitened residuals.
    damping, growth : array (N,)
        Of the step, and the factor if it is refused.
    tolerance : float
        A fix is finished when a step is shorter than this many of its standard deviations.
    damped : bool
        False: every step is taken whatever it does to the cost.
    """
    achieved, floor = cost - after, _ROUNDING * (1.0 + cost)
    rounding = floor + 2.0 * blur * np.sqrt(1.0 + cost)
    better = solvable & np.isfinite(after) & ((achieved >= -rounding) if damped else True)
    small = solvable & (np.abs(gain) * (1.0 + damping) <= np.maximum(tolerance * tolerance, floor + blur * blur))
    ratio = achieved / np.where(gain > 0.0, gain, 1.0)
    middle = 2.0 * np.clip(ratio, 0.0, 1.0) - 1.0
    change = np.where(ratio > _AGREED, _QUICK_FALL, np.maximum(_FALL, 1.0 - middle * middle * middle))
    new = np.where(better, np.maximum(damping * change, _LEAST), damping * growth + _LEAST)
    return Judged(better, small, ~better & (new > _MOST), new, np.where(better, FIRST_GROWTH, 2.0 * growth))


@compiled
def judge_lane(
    cost: float,
    after: float,
    gain: float,
    solvable: bool,
    blur: float,
    damping: float,
    growth: float,
    tolerance: float,
    damped: bool,
) -> tuple[bool, bool, bool, float, float]:
    """Judge a step of one fix: the same to the last bit, as machine code; returns the fields of `Judged`."""
    achieved, floor = cost - after, _ROUNDING * (1.0 + cost)
    rounding = floor + 2.0 * blur * np.sqrt(1.0 + cost)
    better = solvable and np.isfinite(after) and (achieved >= -rounding or not damped)
    small = solvable and abs(gain) * (1.0 + damping) <= max(tolerance * tolerance, floor + blur * blur)
    if not better:
        new = damping * growth + _LEAST
        return False, small, new > _MOST, new, 2.0 * growth
    ratio = achieved / (gain if gain > 0.0 else 1.0)
    middle = 2.0 * min(max(ratio, 0.0), 1.0) - 1.0
    change = _QUICK_FALL if ratio > _AGREED else max(_FALL, 1.0 - middle * middle * middle)
    return True, small, False, max(damping * change, _LEAST), FIRST_GROWTH
