"""What is proven of many fixes: certificates in columns, for an object each takes as long as its proof."""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import isnan
from typing import Annotated

import numpy as np

from optloc.base.records import Axes
from optloc.base.types import Array, Certificate

PROOFS = ("", "unknown", "local", "region", "global")
"""Names of the proofs by their numbers; the first stands where nobody has tried to prove anything."""
UNTRIED, UNKNOWN, LOCAL, REGION, GLOBAL = range(5)

_NONE = Certificate("", "", "").bound


@dataclass(frozen=True, slots=True)
class Claims:
    """Certificates of a batch of fixes; each column is a field of `Certificate`, and the proof is told by its number.

    Parameters
    ----------
    proof : int array (...)
        Numbers in `PROOFS`.
    reason, method : object array (...)
        Sentences and words.
    bound, gap : array (...)
        Lower bounds of the costs, and the costs less these; NaN where none was computed.
    unique : bool array (...)
        Whether there is a gap to other minima.
    margin : array (...)
        That gap; 0 where there is none.
    boxes : int array (...)
        Boxes looked at.
    region : object array (...)
        Corners of the regions of the claims; None where they are not about one.
    asked : bool array (...)
        Whether somebody asked for that region.
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
        """Return where somebody has tried to prove something, (...)."""
        return np.asarray(self.proof != UNTRIED)

    def write(self, items: Array | int, other: Claims) -> None:
        """Write others in the place of some, by index or mask: as many (n,), or one () for all."""
        places = np.atleast_1d(items)  # an object array would take an array () for an object
        for each in fields(self):
            getattr(self, each.name)[places] = getattr(other, each.name)

    def tell(self) -> Array:
        """Return the certificates as an object array (...), not to be written to; None where nobody has tried."""
        out = np.empty(self.proof.shape, dtype=object)
        names = [each.name for each in fields(self)]
        columns = (getattr(self, name).ravel().tolist() for name in names)
        for i, values in zip(np.ndindex(out.shape), zip(*columns, strict=True), strict=True):
            own = dict(zip(names, values, strict=True))
            # one NaN, so that certificates without a bound are equal
            none = {name: _NONE for name in ("bound", "gap") if isnan(own[name])}
            out[i] = Certificate(**own | none | {"proof": PROOFS[own["proof"]]}) if own["proof"] else None
        out.flags.writeable = False
        return out


def claim(certificate: Certificate) -> Claims:
    """Return a certificate as claims without batch axes."""
    out = empty_claims(1)
    out.proof[0] = PROOFS.index(certificate.proof)
    for each in fields(out)[1:]:
        getattr(out, each.name)[0] = getattr(certificate, each.name)
    return Claims(*(getattr(out, each.name).reshape(()) for each in fields(out)))


def empty_claims(count: int) -> Claims:
    """Return claims (count,) about fixes of which nobody has tried to prove anything, to be written."""
    empty = (UNTRIED, "", "", np.nan, np.nan, False, 0.0, 0, None, False)
    kinds = (np.int8, object, object, float, float, np.bool_, float, np.int64, object, np.bool_)
    return Claims(*(np.full(count, value, dtype=kind) for value, kind in zip(empty, kinds, strict=True)))


def repeated_claims(one: Claims, shape: int | tuple[int, ...]) -> Claims:
    """Return claims (...) that are all the same; nobody can write into them."""
    return Claims(*(np.broadcast_to(getattr(one, each.name), shape) for each in fields(one)))


def merged_claims(chosen: Array, one: Claims, other: Claims) -> Claims:
    """Return claims (N,) of which those chosen are from one, and the rest from another, each (N,) or ()."""
    pairs = ((getattr(one, each.name), getattr(other, each.name)) for each in fields(one))
    return Claims(*(np.where(chosen, *pair) for pair in pairs))
