"""What a proof lets a certificate say, in sentences."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from optloc.status import Certificate
from optloc.types import Array

Corner = tuple[float, ...]

METHOD = "branch and bound"
# Reasons for which nothing is proven.
BUDGET = "the proof was not finished within its budget of boxes"
UNSETTLED = "the rows do not make the fix a strict minimum that stands out from its neighbourhood"
BARRED = "a position that costs less is not admitted: a constraint or the Earth forbids it"
HELD = "an inequality holds the fix, and the proof covers equalities only"
REMOTE = "positions ever farther away explain the data about as well"
TURNS = "angles may be a whole turn off with their biases at costs that matter"
RESTLESS = "minima kept turning up"


def unknown(reason: str) -> Certificate:
    """Return the certificate of a fix of which nothing is proven, with the reason."""
    return Certificate("unknown", reason, METHOD)


def claimed(
    cost: float, bound: float, margin: float, boxes: int, listed: int, region: tuple[Corner, Corner] | None
) -> Certificate:
    """Return the certificate of a proven fix.

    Parameters
    ----------
    cost, bound : float
        Of the fix, and the certified lower bound.
    margin : float
        Proven gap to other minima; 0 for the value alone.
    boxes : int
        Boxes looked at.
    listed : int
        How many alternatives the claim leaves out, because they are listed.
    region : (lower, upper), optional
        Corners of the region of the claim; None: all positions.
    """
    proof, sentence = "global" if region is None else "region", _sentence(margin, listed, region)
    return Certificate(proof, sentence, METHOD, bound, cost - bound, margin > 0.0, margin, boxes, region)


@lru_cache(maxsize=256)
def _sentence(margin: float, listed: int, region: tuple[Corner, Corner] | None) -> str:
    where = "no position" if region is None else f"no position from {_text(region[0])} to {_text(region[1])} m"
    beside = "" if not listed else " but that listed" if listed == 1 else f" but the {listed} listed"
    if margin > 0.0:
        rest = f"no other minimum{beside} has a cost within {margin:g} of it"
    else:
        rest = "other minima were searched for, not excluded"
    return f"{where} costs less; {rest}"


def _text(corner: Corner) -> str:
    return "(" + ", ".join(f"{v:.6g}" for v in corner) + ")"


def column(certificates: list[Certificate]) -> Array:
    """Return certificates as an object array."""
    out = np.empty(len(certificates), dtype=object)
    out[:] = certificates
    return out
