"""What many accusations mean: a noise that is understated, one station that is wrong, late rows, or an offset."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Array
from optloc.model_checks.elements import Elements, elements, kinds_of
from optloc.model_checks.groups import ROW_PRICE
from optloc.model_checks.score import descend
from optloc.model_checks.variance_components import Tested, error_sizes, fit, snooped, tested, total, without
from optloc.problem.loss import LATE
from optloc.problem.noise import Noise
from optloc.problem.problem import Problem

SEVERAL = 3
"""Fixes from which the level of the noise is asked for: of fewer one liar each is as likely."""

ACCUSED = 0.01
"""Chi-square probability below which a fix accuses somebody: that from which `robust` looks for suspects."""

# Factors of sigma that are tried: a grid of 5 % over what a wrong unit would not explain better.
_FACTORS = np.exp(np.arange(-60, 100) * 0.05)
# Share of late rows from which they are no exception: what all have in common may be an offset.
_MINORITY = 0.5
# Share of late rows from which no row on time is left that others are late against: few fixes of hardly any redundancy
# are explained by that as well as by noise of another size.
_NEARLY_ALL = 0.95
# Change of sigma that is worth a word: 20 % of it move no fix by a tenth of its sigma.
_WORTH = 1.2
# Eigenvalue of the tests of a group, as a share of the largest, below which it is rounding.
_NOTHING = 1e-9


@dataclass(frozen=True, slots=True)
class CommonLevel:
    """What explains the misfit of many fixes at the least price.

    Parameters
    ----------
    kinds : tuple of str
        Kinds of rows.
    factor, low, high : array (k,)
        What the stated standard deviations of each are to be multiplied by, and its interval of 95 %; 1 where the noise
        is not the suspect, or where one of the other kinds is.
    suspect : bool
        Whether the noise is the suspect.
    alone : str
        Whose errors alone, a station's or a kind's, are larger than stated, if that explains more than a factor of all.
    size : float
        How many times larger these are; NaN where there is none.
    gain : float
        By how much twice the logarithm of the likelihood is larger than with the noise as stated.
    fixes : int
        Fixes with redundancy.
    accused, left : int
        Those of them that a chi-square test at 1 % rejects, with the noise as stated and with the factors.
    """

    kinds: tuple[str, ...]
    factor: Array
    low: Array
    high: Array
    suspect: bool
    alone: str
    size: float
    gain: float
    fixes: int
    accused: int
    left: int

    @property
    def sentence(self) -> str:
        """Return what is found in one sentence without its full stop; empty where nothing is."""
        accused = f"{self.accused} of {self.fixes} fixes accuse somebody"
        if self.suspect:
            parts = [
                f"{f:.2g} times the stated one ({a:.2g} to {b:.2g}){f' in {kind} rows' if len(self.kinds) > 1 else ''}"
                for kind, f, a, b in zip(self.kinds, self.factor, self.low, self.high, strict=True)
                if f != 1.0
            ]
            return f"the noise level is the suspect: {accused}, and {self.left} with {' and '.join(parts)}"
        if self.alone:
            what = f"errors of {self.alone} are {self.size:.2g} times as large as stated"
            return f"{accused}, and what is wrong is {self.alone}: {what}, or biased"
        return ""

    @property
    def refutes(self) -> bool:
        """Return whether noise is stated too small: what is claimed of such fixes does not hold."""
        return self.suspect and bool((self.factor > 1.0).any())

    def sizes(self, problem: Problem) -> Array:
        """Return the factors (m,) of the rows of a problem."""
        factor = dict(zip(self.kinds, self.factor.tolist(), strict=True))
        return np.array([factor.get(kind, 1.0) for kind in kinds_of(problem).tolist()])

    def scale(self, problem: Problem) -> Problem:
        """Return a problem of the same kinds with its noise times the factors.

        Parameters
        ----------
        problem : Problem
            Of any epochs; kinds that were not there stay as they are.
        """
        size = self.sizes(problem)
        blocks = [
            replace(b, covariance=b.covariance * size[b.row][:, :, None] * size[b.row][:, None, :])
            for b in problem.noise.blocks
        ]
        return replace(problem, noise=Noise(tuple(blocks)))


def common_level_at(problem: Problem, x: Array) -> CommonLevel:
    """Return what explains the misfit of fixes: the noise as stated, a factor of it, or one station or kind.

    Every fix may leave out measurements at a price each, under any of these: a few liars are no larger noise. Of a fix
    whose cost is c_k without k measurements and whose redundancy then is r_k, twice the negative logarithm of the
    restricted likelihood with sigma times f is ``c_k / f^2 + r_k ln f^2`` and the price of k (see `ROW_PRICE`); the
    measurements that are left out are those that stand out most, one after another, to first order at the fix. A
    factor of one station or kind changes c and r by the update of V for its errors. What is cheapest over all fixes,
    the price of its factor included, is what is told; the factors are those of `variance_components.fit`.

    Parameters
    ----------
    problem : Problem
        A flat batch of N problems, of `elements.batch_of`.
    x : array (N, size)
        Their fixes, robust or not; NaN where there is none.
    """
    kept = np.flatnonzero(np.isfinite(x).all(-1))
    kinds = tuple(dict.fromkeys(rows.kind for rows in problem.rows))
    same = np.ones(len(kinds))
    none = CommonLevel(kinds, same, same, same, False, "", np.nan, 0.0, 0, 0, 0)
    if not len(kept):
        return none
    batch, x = problem.take(kept), x[kept]
    by_station, by_kind = elements(batch, x, "station"), elements(batch, x, "kind")
    tests = tested(by_station, np.ones(()))
    cost, dof = _path(tests)
    count, accused = int((tests.dof > 0).sum()), _accused(tests)
    none = replace(none, fixes=count, accused=accused, left=accused)
    if not count or not accused:
        return none
    stated = _least(cost, dof, 1.0)
    common = np.array([_least(cost, dof, f).sum() for f in _FACTORS])
    # What a factor of one group explains, every fix may explain by leaving out measurements instead.
    single = [*_alone(by_station, tests, cost, dof)]
    single += [*_alone(by_kind, tested(by_kind, np.ones(())), cost, dof)] if len(kinds) > 1 else []
    name, size, least = min(single, key=lambda one: one[2], default=("", np.nan, np.inf))
    gain = float(stated.sum() - min(common.min(), least))
    if gain <= ROW_PRICE:
        return none
    if least < common.min() and name not in kinds:
        return replace(none, alone=name, size=size, gain=gain)
    # A minority of late rows widens what is left like a larger noise does: who is late is then said of each fix.
    if 0.0 < _late_rows(by_kind, _able(batch)).share < _MINORITY:
        return replace(none, gain=gain)
    return _rescaled(replace(none, gain=gain), by_kind)


def _rescaled(none: CommonLevel, made: Elements) -> CommonLevel:
    """Return the factors of all kinds; those that need none keep theirs."""
    left = np.zeros(len(made.names), dtype=bool)
    found = fit(made, left, left)
    place = [made.names.index(kind) if kind in made.names else -1 for kind in none.kinds]
    factor, low, high = (np.append(np.sqrt(v), np.nan)[place] for v in (found.variance, found.low, found.high))
    with np.errstate(invalid="ignore"):
        told = ((low > 1.0) | (high < 1.0)) & (np.abs(np.log(factor)) > np.log(_WORTH))
    if not told.any():
        return none
    factor, low, high = (np.where(told, v, 1.0) for v in (factor, low, high))
    own = np.append(factor, 1.0)[[none.kinds.index(n) if n in none.kinds else -1 for n in (*made.names, "")]]
    after = tested(made, own[made.of_effect] ** 2)
    return replace(none, factor=factor, low=low, high=high, suspect=True, left=_accused(after))


def _accused(tests: Tested) -> int:
    """Return how many fixes the chi-square test rejects."""
    from scipy.special import gammaincc

    return int(((tests.dof > 0) & (gammaincc(np.maximum(tests.dof, 1) / 2, tests.cost / 2) < ACCUSED)).sum())


def _path(tests: Tested) -> tuple[Array, Array]:
    """Return cost and redundancy (N, 1 + k) without none, one, ... of the errors that stand out most.

    Only those beyond the price are tried; a fix that has fewer of them repeats its last.
    """
    costs, dofs = [tests.cost], [tests.dof]
    while True:
        sigmas = np.abs(tests.sigmas[:, : tests.errors])
        worst = sigmas.argmax(1)
        hit = (sigmas[np.arange(len(worst)), worst] > np.sqrt(ROW_PRICE)) & (tests.dof > 0)
        if not hit.any():
            return np.stack(costs, axis=1), np.stack(dofs, axis=1)
        tests = tests.without(np.where(hit, worst, -1))
        costs.append(np.where(hit, tests.cost, np.inf))
        dofs.append(tests.dof)


def priced_cost(tests: Tested) -> Array:
    """Return the least cost of each fix (N,) with any of its errors left out, at the price of each."""
    return _least(*_path(tests), 1.0)


def _least(cost: Array, dof: Array, factor: float) -> Array:
    """Return the least of twice the negative log-likelihood of each fix (N,) with sigma times a factor."""
    left = np.arange(cost.shape[1])
    return np.asarray((cost / factor**2 + dof * np.log(factor**2) + ROW_PRICE * left).min(1))


def _alone(made: Elements, tests: Tested, cost: Array, dof: Array) -> Iterator[tuple[str, float, float]]:
    """Yield each group, the factor of sigma of its errors alone that explains most, and the likelihood with it.

    With V + (f^2 - 1) B B' for the columns B of a group, T of `Tested` for them and its eigenvalues l and vectors, in
    which t has the components y, the cost falls by (f^2 - 1) y^2 / (1 + (f^2 - 1) l), summed, and the determinants grow
    by 1 + (f^2 - 1) l (A. J. Woodbury 1950), also of a fix that leaves out another measurement instead.
    """
    left = ROW_PRICE * np.arange(1, cost.shape[1])
    instead = (cost[:, 1:] + left).min(1, initial=np.inf)
    for g in np.flatnonzero(total(made.of_effect, len(made.names))):
        own = made.of_effect == g
        # Its columns first; the others of the same number are zeros.
        order = np.argsort(~own, axis=1, kind="stable")[:, : int(own.sum(1).max())]
        here = np.take_along_axis(own, order, 1)
        matrix = np.take_along_axis(np.take_along_axis(tests.matrix, order[:, :, None], 1), order[:, None], 2)
        values, vectors = np.linalg.eigh(np.where(here[:, :, None] & here[:, None, :], matrix, 0.0))
        seen = values > _NOTHING * values[:, -1:]
        vector = np.where(here, np.take_along_axis(tests.vector, order, 1), 0.0)
        squared = np.where(seen, (np.swapaxes(vectors, 1, 2) @ vector[..., None])[..., 0] ** 2, 0.0)
        values = np.where(seen, values, 0.0)
        more = _FACTORS[_FACTORS > 1.0, None, None] ** 2 - 1.0
        grown = 1.0 + more * values
        determinant = np.log(grown).sum(-1)
        each = tests.cost - (more * squared / grown).sum(-1)
        sums = (determinant + np.minimum(each, instead)).sum(-1)
        best = int(sums.argmin())
        yield made.names[g], float(np.sqrt(1.0 + more[best, 0, 0])), float(sums[best])


# Late rows: how many of them there are, by how much, and which fixes stand on them.


@dataclass(frozen=True, slots=True)
class LateSignals:
    """How many ranges and arrivals are late, as the residuals of many fixes show it.

    Parameters
    ----------
    share, delay : float
        Probability of a row to be late, and the mean delay of those in sigmas of the rows; zero where none are seen.
    gain : float
        Twice the logarithm of the likelihood over that of no late row.
    count : int
        Rows that the rest of their fix can check.
    late : int array (N,)
        Rows of each fix that are late rather than not.
    carried : bool array (N,)
        Fixes that stand on late rows: without these nothing checks them.
    alike : str
        Kind whose rows are all late by one amount, which then are not counted as late; empty for none.
    offset, offset_error : float
        That amount and its standard deviation, SI units.
    left : float
        Chi-square of all fixes without the late rows, and the price of these.
    """

    share: float
    delay: float
    gain: float
    count: int
    late: Array
    carried: Array
    alike: str = ""
    offset: float = 0.0
    offset_error: float = 0.0
    left: float = 0.0

    @property
    def method(self) -> str:
        """Return the method that fixes with such rows, for `solve`; "late" where none are seen."""
        return f"late({self.share:.3g},{self.delay:.3g})" if self.share else "late"

    @property
    def sentence(self) -> str:
        """Return what is found in one sentence without its full stop; empty where no row is late."""
        if self.alike:
            size = f"{self.offset:.4g} ± {self.offset_error:.2g} m"
            return f"all {self.alike} rows are late alike, by {size}: that looks like a bias, an offset per kind"
        if not self.share:
            return ""
        text = f"{100.0 * self.share:.2g} % of {self.count} rows are late, by {self.delay:.2g} sigma on average"
        stand = int(self.carried.sum())
        return text + (f"; {stand} of {len(self.late)} fixes stand on late rows" if stand else "")


def late_signals_at(problem: Problem, kept: Array, x: Array) -> LateSignals:
    """Return the late rows of fixes that were made before; see `late_signals`.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems, of `batch_of`.
    kept : int array (n,)
        Those that have a fix.
    x : array (n, size)
        Their parameter vectors.
    """
    late, carried = np.zeros(problem.batch_shape[0], dtype=int), np.zeros(problem.batch_shape[0], dtype=bool)
    able = _able(problem)
    if not able:
        return LateSignals(0.0, 0.0, 0.0, 0, late, carried)
    part = problem.take(kept)
    found = _late_rows(elements(part, x, "kind"), able)
    if found.share:
        kind, offset, error, left = min((_alike(part, x, one) for one in able), key=lambda one: one[3])
        if offset > 0.0 and left < found.left:
            found = replace(found, share=0.0, delay=0.0, alike=kind, offset=offset, offset_error=error)
            return replace(found, late=late, carried=carried)
        if found.share > _NEARLY_ALL:  # late against what
            return replace(found, share=0.0, delay=0.0, late=late, carried=carried)
    late[kept], carried[kept] = found.late, found.carried
    return replace(found, late=late, carried=carried)


# Turns of choosing late rows and of expectation and maximisation, and the change of both numbers that ends the latter.
_CHOICES, _TURNS, _ENDED = 10, 500, 1e-6
# Mean delay, sigmas, below which it is none: it moves no fix by what anybody notices.
_NO_DELAY = 0.1
# Test, standard deviations, from which a row is taken for late to begin with.
_STANDS_OUT = 3.0
# Share of what gross errors of either side explain that late rows have to: 0.8 to 1 where a tenth or more are late by 5
# sigma on average, 0.6 at the most where the noise is three or five times what is stated (50 fixes).
_ONE_SIDED = 0.7


def _able(problem: Problem) -> list[str]:
    """Return the kinds of a problem that may be late."""
    return [rows.kind for rows in problem.rows if rows.kind in LATE]


def _late_rows(made: Elements, able: list[str]) -> LateSignals:
    """Return the late rows of linearised fixes, their noise as stated."""
    tests = tested(made, np.ones(()))
    fit_for = np.isin(np.array([*made.names, ""], dtype=object)[made.of_effect], able)
    share, delay, gain, late, seen = _mixture(tests, fit_for)
    none = np.zeros(len(late), dtype=int)
    # What leaving out late rows explains of what leaving out rows of either side does, at a price each: half of it
    # where errors are tails, less where the noise is understated.
    left = float((without(tests, late).cost + ROW_PRICE * late.sum(1)).sum())
    explained = float(tests.cost.sum()) - left
    if min(gain, explained) <= ROW_PRICE or explained < _ONE_SIDED * float((tests.cost - priced_cost(tests)).sum()):
        return LateSignals(0.0, 0.0, max(gain, 0.0), seen, none, none > 0)
    count = late.sum(1)
    return LateSignals(share, delay, gain, seen, count, (count > 0) & (tests.dof - count <= 0), left=left)


# Steps of an offset, each with fixes made anew, and the move in its sigma that ends them.
_STEPS, _STILL = 8, 0.1


def _alike(problem: Problem, x: Array, kind: str) -> tuple[str, float, float, float]:
    """Return a kind, the offset that all its rows have in common, its standard deviation, and what is left to explain.

    Gauss-Newton over all fixes together, each of which is refined in between: the rows are as late as they are, and a
    fix may be far off for it.
    """
    own = np.concatenate([np.full(rows.count, rows.kind == kind) for rows in problem.rows])
    offset, error = 0.0, np.inf
    tests = None
    for _ in range(_STEPS):
        moved = problem.with_rows(z=problem.z - offset * own)
        x, _ = descend(moved, x)
        made = elements(moved, x, "kind")
        tests = tested(made, np.ones(()))
        here = made.of_offset == made.names.index(kind)
        size = float(tests.size[:, tests.errors :][here].sum())
        if size <= 0.0:  # a common delay is a time of emission
            return kind, 0.0, np.inf, np.inf
        step, error = float(tests.vector[:, tests.errors :][here].sum()) / size, size**-0.5
        if abs(step) <= _STILL * error:
            break
        offset += step
    return kind, offset, error, np.inf if tests is None else float(priced_cost(tests).sum()) + ROW_PRICE


def _mixture(tests: Tested, able: Array) -> tuple[float, float, float, Array, int]:
    """Return share, mean delay, gain, late rows (N, q) and the number of rows that are checked."""
    found = snooped(tests, slice(0, tests.errors), _STANDS_OUT)
    late = found.gross & able & (found.shift > 0.0)
    share = delay = gain = 0.0
    seen = able & np.isfinite(found.shift)
    for _ in range(_CHOICES):
        shift, sigma = _without_others(tests, late)
        seen = able & np.isfinite(shift)
        share, delay, gain, chance = _expect(shift[seen], sigma[seen], late[seen])
        now = np.zeros(late.shape, dtype=bool)
        now[seen] = chance > 0.5
        # Rows that nothing checks once the others are left out stay what they were.
        now |= late & ~seen
        if (now == late).all():
            break
        late = now
    return share, delay, gain, late, int(seen.sum())


def _without_others(tests: Tested, late: Array) -> tuple[Array, Array]:
    """Return the error (N, q) of each row, and its sigma, that the others show which are not late."""
    items, q = np.arange(len(late)), tests.errors
    shift, sigma = error_sizes(without(tests, late), slice(0, q))
    order = np.argsort(~late, axis=1, kind="stable")[:, : int(late.sum(1).max(initial=0))]
    for column in order.T:
        own = late[items, column]
        others = late.copy()
        others[items, column] = False
        # of a late row all the other late ones are left out, not itself
        one, error = error_sizes(without(tests, others), slice(0, q))
        shift[items[own], column[own]] = one[items[own], column[own]]
        sigma[items[own], column[own]] = error[items[own], column[own]]
    return shift, sigma


def _expect(error: Array, sigma: Array, late: Array) -> tuple[float, float, float, Array]:
    """Return share, mean delay and gain, and the chance of each row to be late: errors are normal, plus delays."""
    from scipy.special import erfcx, log_ndtr

    share = float(np.clip(late.mean(), 0.5 / max(len(late), 1), 0.9)) if len(late) else 0.0
    delay = float(np.mean(error[late])) if late.any() else 0.0
    if not share or delay <= 0.0:
        return 0.0, 0.0, 0.0, np.zeros(len(error))
    prompt = -0.5 * (error / sigma) ** 2 - np.log(sigma) - 0.5 * np.log(2.0 * np.pi)
    for _ in range(_TURNS):
        # A delay given the error is normal about error - sigma^2 / delay, cut off at zero.
        middle = error - sigma**2 / delay
        tail = log_ndtr(middle / sigma)
        density = np.log(share / delay) + 0.5 * (sigma / delay) ** 2 - error / delay + tail
        both = np.logaddexp(np.log1p(-share) + prompt, density)
        chance = np.exp(density - both)
        # its mean: the density over the distribution of a normal variable, as erfcx has it without cancellation
        mean = middle + sigma * np.sqrt(2.0 / np.pi) / erfcx(-middle / (np.sqrt(2.0) * sigma))
        new = float(np.clip(chance.mean(), 1e-12, 1.0 - 1e-6))
        longer = float((chance * mean).sum() / max(chance.sum(), 1e-300))
        done = abs(new - share) <= _ENDED * share and abs(longer - delay) <= _ENDED * delay
        if longer < _NO_DELAY:
            return 0.0, 0.0, 0.0, np.zeros(len(error))
        share, delay = new, longer
        if done:
            break
    return share, delay, float(2.0 * (both - prompt).sum()), chance
