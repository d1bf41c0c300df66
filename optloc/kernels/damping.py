"""The rules by which a damped Gauss-Newton step is accepted or is the last one, for arrays and for lanes.

Levenberg's method with Marquardt's scaling. A step is accepted if it does not raise the cost by more than rounding
explains. The damping follows the ratio of the achieved decrease to the decrease in the linear model. It falls
continuously where they agree, and grows faster and faster while steps are rejected. A fix has converged if its next
step is shorter than a share of its standard deviations. A fix is stuck if no damping helps.

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
"""Initial damping. Starts are closed forms near the minimum, where undamped steps are best (Nielsen's tau)."""
FIRST_GROWTH = 2.0
"""Factor of the damping when a step is rejected; each further rejection doubles it (Nielsen's nu)."""

# Rounding error of a cost, relative to the cost plus one: 450 units in the last place, for sums of some hundred
# squares.
_ROUNDING = 1e-13
# Least damping. From zero no factor leads back; at this value only the last digits of a step are damped.
_LEAST = 1e-12
# Greatest damping, the inverse of the least: steps with this damping change only the last digits.
_MOST = 1e12
# Nielsen's limits of one change: at most to a third, or to a tenth if the linear model agrees to 10 %.
_FALL, _QUICK_FALL, _AGREED = 1.0 / 3.0, 0.1, 0.9


class StopRules(NamedTuple):
    """The conditions that end a refinement; see `optloc.kernels.least_squares.refine`, which has the same defaults.

    `tolerance` is the length of the last step in standard deviations, `limit` the greatest number of steps. If `damped`
    is False, every step is accepted.
    """

    tolerance: float = 1e-7
    limit: int = 60
    damped: bool = True


class Judged(NamedTuple):
    """The decision on a step; each field is an array (N,) or a scalar.

    Parameters
    ----------
    better : bool
        Whether the step is accepted.
    small : bool
        Whether the step was the last, because the fix has converged.
    stuck : bool
        Whether the step was rejected and no damping helps.
    damping, growth : float
        Values for the next step.
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
    """Return the decision on one step of each of N fixes.

    Parameters
    ----------
    cost, after : array (N,)
        Cost before and after the step.
    gain : array (N,)
        Step times right side: the squared length of the step in standard deviations, apart from the damping.
    solvable : bool array (N,)
        Whether the normal equations have a solution.
    blur : array (N,)
        Rounding error of the whitened residuals.
    damping, growth : array (N,)
        Damping of the step, and the factor if the step is rejected.
    tolerance : float
        A fix has converged if a step is shorter than this number of standard deviations.
    damped : bool
        If False, every step is accepted, even if it raises the cost.
    """
    achieved, floor = cost - after, _ROUNDING * (1.0 + cost)
    rounding = floor + 2.0 * blur * np.sqrt(1.0 + cost)
    better = solvable & np.isfinite(after) & ((achieved >= -rounding) if damped else True)
    small = solvable & (np.abs(gain) * (1.0 + damping) <= np.maximum(tolerance * tolerance, floor + blur * blur))
    # Nielsen's factor of the damping after an accepted step: 1 - (2 ratio - 1)^3, limited from below
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
    """Return the five fields of `Judged` for one step of one fix: `judge` as machine code, with identical rounding.

    The order is better, small, stuck, damping, growth. The arguments are the arguments of `judge`, as numbers.
    """
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
