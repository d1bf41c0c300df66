"""Certificates of many fixes, stored as one array per field. One `Certificate` object per fix would be too slow."""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import isnan
from typing import Annotated

import numpy as np

from optloc.base.records import Axes
from optloc.base.types import Array, Certificate, Status

PROOFS = ("", "unknown", "local", "region", "global")
"""Names of the proofs, in the order of their numbers. The first, "", means that no proof was tried."""
UNTRIED, UNKNOWN, LOCAL, REGION, GLOBAL = range(5)

_NONE = Certificate("", "", "").bound

NO_PROOF_METHODS = ("", "none", "refinement")
"""Methods of certificates of fixes for which no proof was tried."""

# The advice for an unproven fix depends on what its method has already done. A method without a proof has one step
# left. More measurements do not help if no proof covers the rows.
_WITHOUT_PROOF = (
    "The position is refined, but no proof was tried, so another position is not excluded; use the method 'auto', "
    "which tries a proof, or accept this status with 'allow'."
)
_NOT_COVERED = (
    "The position is refined, but no proof covers the problem, as the reason states, so another position is not "
    "excluded; compare it with other data, or accept this status with 'allow'."
)
# Sentence of each status, by its number.
_OF_STATUS = np.array([Status(number).sentence for number in range(len(Status))], dtype=object)


@dataclass(frozen=True, slots=True)
class Claims:
    """Certificates of a batch of fixes. Each column is a field of `Certificate`; the proof is stored as a number.

    Parameters
    ----------
    proof : int array (...)
        Indices in `PROOFS`.
    reason, method : object array (...)
        Reasons, as sentences, and names of the methods.
    bound, gap : array (...)
        Lower bounds of the costs, and the costs minus these bounds; NaN if no bound was computed.
    unique : bool array (...)
        Whether all other minima cost more by a known margin.
    margin : array (...)
        This margin; 0 without one.
    boxes : int array (...)
        Number of boxes that the proof examined.
    region : object array (...)
        Corners of the region of each proof; None if the proof has no region.
    asked : bool array (...)
        Whether the caller requested this region.
    """

    proof: Annotated[Array, Axes(0, empty=UNTRIED)]
    reason: Annotated[Array, Axes(0, empty="")]
    method: Annotated[Array, Axes(0, empty="")]
    bound: Annotated[Array, Axes(0)]
    gap: Annotated[Array, Axes(0)]
    unique: Annotated[Array, Axes(0, empty=False)]
    margin: Annotated[Array, Axes(0, empty=0.0)]
    boxes: Annotated[Array, Axes(0, empty=0)]
    region: Annotated[Array, Axes(0, empty=None)]
    asked: Annotated[Array, Axes(0, empty=False)]

    @property
    def tried(self) -> Array:
        """Return a mask (...) of the fixes for which a proof was tried."""
        return np.asarray(self.proof != UNTRIED)

    def write(self, items: Array | int, other: Claims) -> None:
        """Overwrite the entries at `items` (indices or a mask) with `other`: n claims (n,), or one claim () for all."""
        places = np.atleast_1d(items)  # with a scalar index NumPy would store an array () as an object
        for each in fields(self):
            getattr(self, each.name)[places] = getattr(other, each.name)

    def tell(self) -> Array:
        """Return the certificates as a read-only object array (...) of `Certificate`; None where no proof was tried."""
        out = np.empty(self.proof.shape, dtype=object)
        names = [each.name for each in fields(self)]
        columns = (getattr(self, name).ravel().tolist() for name in names)
        for i, values in zip(np.ndindex(out.shape), zip(*columns, strict=True), strict=True):
            entries = dict(zip(names, values, strict=True))
            # All missing bounds share one NaN object, so that certificates without a bound compare as equal.
            missing = {name: _NONE for name in ("bound", "gap") if isnan(entries[name])}
            out[i] = (
                Certificate(**entries | missing | {"proof": PROOFS[entries["proof"]]}) if entries["proof"] else None
            )
        out.flags.writeable = False
        return out


def claim(certificate: Certificate) -> Claims:
    """Return a certificate as claims without batch axes, each field of shape ()."""
    out = empty_claims(1)
    out.proof[0] = PROOFS.index(certificate.proof)
    for each in fields(out)[1:]:
        getattr(out, each.name)[0] = getattr(certificate, each.name)
    return Claims(*(getattr(out, each.name).reshape(()) for each in fields(out)))


def empty_claims(count: int) -> Claims:
    """Return writable claims (count,) of fixes for which no proof was tried."""
    empty = (UNTRIED, "", "", np.nan, np.nan, False, 0.0, 0, None, False)
    kinds = (np.int8, object, object, float, float, np.bool_, float, np.int64, object, np.bool_)
    return Claims(*(np.full(count, value, dtype=kind) for value, kind in zip(empty, kinds, strict=True)))


def repeated_claims(one: Claims, shape: int | tuple[int, ...]) -> Claims:
    """Return read-only claims of the given shape that are all equal to `one`, which has no batch axes."""
    return Claims(*(np.broadcast_to(getattr(one, each.name), shape) for each in fields(one)))


def merged_claims(chosen: Array, one: Claims, other: Claims) -> Claims:
    """Return claims (N,): `one` where `chosen` (N,) is true, otherwise `other`; each has shape (N,) or ()."""
    pairs = ((getattr(one, each.name), getattr(other, each.name)) for each in fields(one))
    return Claims(*(np.where(chosen, *pair) for pair in pairs))


def sentences_of(code: Array, claims: Claims) -> Array:
    """Return the sentences of statuses as an object array (...), with advice that the method has not yet followed.

    `code` (...) has the numbers of the statuses, and `claims` (...) the certificates of the fixes.
    """
    sentences = np.asarray(_OF_STATUS[code], dtype=object)  # an index without axes gives a text
    unproven = code == Status.UNPROVEN
    if not unproven.any():
        return sentences
    # A proof that examined no box was not begun: the problem is outside of its scope.
    not_covered = unproven & (claims.proof == UNKNOWN) & (claims.boxes == 0)
    sentences = np.where(not_covered, _NOT_COVERED, sentences)
    return np.where(unproven & np.isin(claims.method, NO_PROOF_METHODS), _WITHOUT_PROOF, sentences)
