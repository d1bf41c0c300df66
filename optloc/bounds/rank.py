"""Observability: the information of data and priors about each unknown, and the combinations that stay undetermined.

Letters: n shared unknowns, p free directions of a basis, q undetermined combinations. A *slot* is the entries of one
named unknown.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from optloc.base.types import Array
from optloc.bounds.cramer_rao import OPEN, free_directions, shared_information, shared_priors, with_local_priors
from optloc.kernels.sums import summed
from optloc.problem.layout import Layout, Slot
from optloc.problem.problem import Problem

# Two unknowns with this correlation would each be known seven times as well if the other were known: 1 / sqrt(1 -
# 0.99^2).
TIED = 0.99
"""Correlation from which a bias is reported as hard to separate from another unknown."""

_SHOWN = 8  # names in one sentence, a line of text; the rest is counted
_FEW = 2  # combinations that are written out; for more, only the names of the unknowns are listed
_NOTHING = 1e-6  # smaller entries of a unit vector are rounding errors; close eigenvalues make these errors larger
_ROUNDED = 1e-5  # the same limit after elimination, which makes rounding errors larger
_ALIKE = 1e-4  # relative difference of changes that are reported as one common change, as printed to three digits


@dataclass(frozen=True, slots=True)
class Observability:
    """Standard deviations of the shared unknowns of a problem, from data, from priors, and from both.

    Parameters
    ----------
    labels : tuple of n str
        Names of the unknowns, for instance "position x" or "clock B".
    units : tuple of n str
        Their SI units.
    data : array (n,)
        Standard deviation from the measurements alone; infinite if they do not determine the unknown.
    prior : array (n,)
        Standard deviation of the prior; infinite without a prior.
    posterior : array (n,)
        Standard deviation from both.
    rank : int
        Number of combinations of the unknowns that the measurements determine.
    open : tuple of str
        Sentences that name the combinations that the measurements do not determine.
    tied : tuple of str
        One sentence for each group of determined unknowns, biases among them, that are hard to separate.
    """

    labels: tuple[str, ...]
    units: tuple[str, ...]
    data: Array
    prior: Array
    posterior: Array
    rank: int
    open: tuple[str, ...]
    tied: tuple[str, ...]

    @property
    def from_data(self) -> Array:
        """Return the share (n,) of the information that the measurements contribute.

        It is one minus the posterior variance over the prior variance: 0 if the prior gives all information, 1 without
        a prior, NaN for an undetermined unknown.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            share_of_variance = np.where(np.isinf(self.prior), 0.0, (self.posterior / self.prior) ** 2)
        return np.where(np.isinf(self.posterior), np.nan, np.clip(1.0 - share_of_variance, 0.0, 1.0))

    @property
    def sentences(self) -> tuple[str, ...]:
        """Return one sentence for each set of inseparable unknowns; empty if all unknowns are separable."""
        return (*self.open, *self.tied)


def observability(problem: Problem, x: Array) -> Observability:
    """Return the information of the data and of the priors about each shared unknown of a problem.

    The method takes the normal matrix of the measurements at x, eliminates unknowns of single epochs and scales its
    columns. Eigenvectors with eigenvalue zero are combinations of unknowns that no measurement determines; all others
    have a finite variance. Station errors that last one epoch, and equality constraints, count with the measurements;
    priors of shared unknowns do not.

    Parameters
    ----------
    problem : Problem
        A single problem.
    x : array (size,)
        Point of linearisation: a fix, or a truth.

    Returns
    -------
    Observability
        In SI units.

    References
    ----------
    S. M. Kay, "Fundamentals of Statistical Signal Processing: Estimation Theory" (1993), sections 3.7 and 10.4.
    G. H. Golub and C. F. Van Loan, "Matrix Computations" (2013), section 5.5.
    """
    x = np.asarray(x, dtype=float)
    layout = problem.layout
    equations = with_local_priors(problem, summed(problem, x))
    information, size = shared_information(equations), equations.shared
    basis = free_directions(problem, x)
    precision = shared_priors(problem)
    data = _split_information(information, size, basis)
    both = _split_information(information + precision, size + precision, basis)
    shown = np.isfinite(data.sigma)  # undetermined unknowns have sentences of another kind
    return Observability(
        layout.labels(),
        tuple(slot.unit for slot in layout.shared for _ in range(slot.size)),
        data.sigma,
        _split_information(precision, precision, np.eye(layout.n_shared)).sigma,
        both.sigma,
        basis.shape[1] - len(data.open),
        tuple(_open_sentences(layout, data)),
        tuple(_tied_sentences(layout, both.correlation * np.outer(shown, shown))),
    )


def open_sentences(layout: Layout, information: Array) -> tuple[str, ...]:
    """Return sentences on the combinations of shared unknowns about which a matrix (n, n) has no information."""
    return tuple(_open_sentences(layout, _split_information(information, information, np.eye(layout.n_shared))))


@dataclass(frozen=True, slots=True)
class _InformationParts:
    """Determined and undetermined combinations of n unknowns.

    `sigma` (n,) are standard deviations, infinite if undetermined, and `correlation` (n, n) the correlations. `open`
    (q, n) is a basis of the undetermined combinations, divided by the scale `reach` (n,) of each unknown.
    """

    sigma: Array
    correlation: Array
    open: Array
    reach: Array


def _split_information(information: Array, size: Array, basis: Array) -> _InformationParts:
    """Return the parts of information (n, n) on a basis (n, p): determined and undetermined combinations.

    `size` (n, n) is the information before elimination; its rounding errors decide what counts as zero.
    """
    # columns are scaled to unit information, so that metres and seconds are comparable
    weight = np.sqrt(np.einsum("ip,ij,jp->p", basis, size, basis).clip(0.0))
    basis = basis / np.where(weight > 0.0, weight, 1.0)
    values, vectors = np.linalg.eigh(basis.T @ information @ basis)
    directions = basis @ vectors
    reach = np.linalg.norm(directions, axis=-1, keepdims=True)
    reach = np.where(reach > 0.0, reach, 1.0)
    determined = values > OPEN
    known, null = directions[:, determined] / np.sqrt(values[determined]), directions[:, ~determined] / reach
    sigma = np.linalg.norm(known, axis=-1)
    # an unknown in an undetermined combination is undetermined
    undetermined = (np.abs(null) > _NOTHING).any(-1)
    unit = known / np.where(sigma > 0.0, sigma, 1.0)[:, None]
    correlation = np.where(undetermined[:, None] | undetermined, 0.0, unit @ unit.T)
    return _InformationParts(np.where(undetermined, np.inf, sigma), correlation, null.T, reach[:, 0])


def _open_sentences(layout: Layout, parts: _InformationParts) -> Iterator[str]:
    """Yield sentences on the undetermined combinations in `parts`, common changes of a bias first."""
    common = np.array([_entries(layout, slot) for slot in layout.shared if slot.members]).reshape(-1, layout.n_shared)
    found = [row for row in common / parts.reach if _inside(row, parts.open)]
    for row in found:
        yield _open_sentence(layout, row * parts.reach)
    rest = _reduce(_orthogonal_rest(parts.open, found))
    if len(rest) <= _FEW:
        yield from (_open_sentence(layout, row * parts.reach) for row in rest)
    else:
        names = [label for label, used in zip(layout.labels(), np.asarray(rest.any(0)), strict=True) if used]
        yield f"the data do not determine {len(rest)} combinations of {_enumerate(names)}"


def _entries(layout: Layout, slot: Slot) -> Array:
    """Return the vector (n,) that changes all entries of a slot by one."""
    place = np.arange(layout.n_shared) - slot.start
    return ((place >= 0) & (place < slot.size)).astype(float)


def _inside(row: Array, basis: Array) -> bool:
    """Return whether a vector `row` (n,) is in the span of a basis (q, n)."""
    away = row - np.linalg.lstsq(basis.T, row, rcond=None)[0] @ basis
    return float(np.linalg.norm(away)) < _NOTHING * float(np.linalg.norm(row))


def _orthogonal_rest(basis: Array, found: list[Array]) -> Array:
    """Return a basis (q - f, n) of the part of a space that is orthogonal to f vectors.

    `basis` (q, n) spans the space, and `found` are f vectors in it.
    """
    if not found:
        return basis
    taken, _ = np.linalg.qr(np.array(found).T)
    # the projection orthogonal to the vectors has the remaining rank
    _, _, right = np.linalg.svd(basis - basis @ taken @ taken.T)
    return np.asarray(right[: len(basis) - len(found)])


def _reduce(rows: Array) -> Array:
    """Return a basis (q, n) of the same space: each row has an entry 1 where all other rows have 0."""
    rows = rows.copy()
    for i in range(len(rows)):
        # Gauss-Jordan with full pivoting: the largest remaining entry becomes one, and the only one of its column
        offset, pivot = divmod(int(np.argmax(np.abs(rows[i:]))), rows.shape[1])
        rows[[i, i + offset]] = rows[[i + offset, i]]
        rows[i] /= rows[i, pivot]
        others = np.arange(len(rows)) != i
        rows[others] -= rows[others, pivot, None] * rows[i]
    return np.where(np.abs(rows) > _ROUNDED, rows, 0.0)


def _open_sentence(layout: Layout, direction: Array) -> str:
    """Return the sentence on a combination `direction` (n,) of unknowns that no measurement determines."""
    labels, names, amounts = layout.labels(), [], []
    for slot in layout.shared:
        unit = "" if slot.unit == "1" else slot.unit
        part = direction[slot.start : slot.start + slot.size]
        if slot.size > 2 and part[0] and np.allclose(part, part[0], rtol=_ALIKE):
            names.append(f"every {slot.name}")
            amounts.append((float(part[0]), unit))
        else:
            names += [labels[slot.start + i] for i in np.flatnonzero(part)]
            amounts += [(float(value), unit) for value in part[part != 0.0]]
    values = np.array([value for value, _ in amounts])
    if len(names) == 1 and not names[0].startswith("every "):
        return f"the data do not determine {names[0]}"
    if len({unit for _, unit in amounts}) == 1 and np.allclose(values, values[0], rtol=_ALIKE):
        return f"the data do not determine a common change of {_enumerate(names)}"
    values = values / values[0]
    shown = [f"{name} by {v:+.3g} {u}".rstrip() for name, v, (_, u) in zip(names, values, amounts, strict=True)]
    return f"the data do not determine a change of {_enumerate(shown)}"


def _tied_sentences(layout: Layout, correlation: Array) -> list[str]:
    """Return a sentence for each group of unknowns with correlations (n, n) above `TIED` that includes a bias."""
    from scipy.sparse.csgraph import connected_components

    labels, found = layout.labels(), []
    bias = np.array([bool(slot.members) for slot in layout.shared for _ in range(slot.size)])
    close = np.abs(np.triu(correlation, 1)) > TIED
    _, group = connected_components(close, directed=False)
    for number in np.unique(group[bias]):
        members = np.flatnonzero(group == number)
        if len(members) > 1:
            most = np.abs(np.triu(correlation[np.ix_(members, members)], 1)).max()
            found.append(f"hard to separate: {_enumerate([labels[i] for i in members])} (correlated up to {most:.5f})")
    return found


def _enumerate(names: list[str]) -> str:
    """Return names as a part of a sentence: "a, b and c", with a limited number of names."""
    if len(names) > _SHOWN:
        names = [*names[: _SHOWN - 1], f"{len(names) - _SHOWN + 1} more"]
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
