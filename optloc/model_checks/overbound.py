"""Overbounds: standard deviations that bound the tails of errors; real noise is seldom normal at five sigma."""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array
from optloc.model_checks.elements import Elements
from optloc.model_checks.variance_components import Tested, VarianceFit, snooped, tested, without

# Limits of a test, in standard deviations, for the comparison of tails: 5 %, 1 % and 0.1 % of normal errors exceed
# them.
_SIZES = np.array([1.960, 2.576, 3.291])
# A count may exceed its expectation by this number of standard deviations: with three, few groups without tails get a
# factor.
_CHANCE = 3.0
# A test above this limit is a gross error here.
_GROSS = 10.0
# A test counts only if the residuals show at least this share of the error.
_SHOWN = 1e-3
# Factors of a variance that are tried: in steps of 5 %, up to sixteen times the standard deviation.
_FACTORS = np.exp(0.05 * np.arange(112))
# Largest number of iterations, and the factor of a variance that counts as one.
_TURNS, _NONE = 8, 1.05


def tail_factors(packed: Elements, found: VarianceFit) -> Array:
    """Return the factor of the standard deviation of each group (g,) with which a Gaussian bounds its tails.

    With k times the variance theta of an error, its test t / sqrt(T) has the variance 1 + (k - 1) theta T. The factor
    is the smallest k that explains the numbers of tests beyond 2, 2.6 and 3.3 sigma. It is an overbound, as in the
    integrity of satellite navigation. Each variance is multiplied by the square root of its factor, and the tests are
    repeated until all factors are one. Errors that the residuals cannot separate share the excess. `packed` are N
    linearised problems, and `found` the variances of their g groups. t and T are the statistics of `Tested`.

    References
    ----------
    B. DeCleene, "Defining pseudorange integrity - overbounding", Proc. ION GPS (2000).
    """
    variance = np.append(np.nan_to_num(found.variance), 0.0)
    # Errors of five sigma are tails; errors of ten sigma are gross.
    gross = snooped(tested(packed, variance[packed.of_effect]), slice(0, packed.effect.shape[-1]), _GROSS).gross
    grown = np.ones(len(variance))
    for _ in range(_TURNS):
        tests = without(tested(packed, (grown * variance)[packed.of_effect]), gross)
        needed = np.array(
            [_needed_factor(tests, packed.of_effect == g, v) for g, v in enumerate((grown * variance)[:-1])]
        )
        if (needed <= _NONE).all():
            break
        grown[:-1] *= np.sqrt(needed)
    return np.sqrt(grown[:-1])


def _needed_factor(tests: Tested, own: Array, variance: float) -> float:
    """Return the smallest factor of a variance with which normal tails bound the tails of some errors.

    `own` (N, q) marks the errors, and `variance` is their present variance. If no tried factor is sufficient, the
    result is the largest of them. The result is 1 if no error affects the residuals enough for a test.
    """
    size = tests.size[:, : tests.errors]
    own = own & (size * variance > _SHOWN)
    count = int(own.sum())
    if not count:
        return 1.0
    # theta T of each error, and its squared test
    share, squared = size[own] * variance, tests.vector[:, : tests.errors][own] ** 2 / size[own]
    expected = count * _tail_probabilities()
    allowed = expected + _CHANCE * np.sqrt(expected) + 1.0
    for factor in _FACTORS:
        # Errors of one fix depend on each other, but most pairs of errors belong to different fixes.
        beyond = squared[:, None] > _SIZES**2 * (1.0 + (factor - 1.0) * share)[:, None]
        if (beyond.sum(0) <= allowed).all():
            return float(factor)
    return float(_FACTORS[-1])


def _tail_probabilities() -> Array:
    """Return the probabilities (3,) that a normal error exceeds each of the three limits of the tests."""
    from scipy.special import ndtr

    return np.asarray(2.0 * ndtr(-_SIZES))
