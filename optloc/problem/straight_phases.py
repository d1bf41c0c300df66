"""S waves of layers as straight rays, for the search of starts: rows of P and S waves of one station become ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optloc.base.types import Rows
from optloc.models.phase_layers import PhaseLayers


def straight_s_rows(s: Rows, others: Sequence[Rows], medium: PhaseLayers) -> Rows:
    """Return arrival times of S waves as rows with straight rays at mean speeds; the rows keep their order.

    An S wave with a P wave of the same station gives a range, because the difference of both times does not contain the
    origin time. Without any P wave, the rows are arrival times. Other S waves get the weight 0.

    Parameters
    ----------
    s : Rows
        Arrival times of S waves along rays.
    others : sequence of Rows
        Arrival times of P waves along rays.
    medium : PhaseLayers
        Medium of both.
    """
    slow = medium.shear.straight
    if not others:
        return replace(s, kind="toa", z=slow * s.z, correction=slow * s.correction)
    p = others[0]
    key = {triple: i for i, triple in enumerate(zip(p.a.tolist(), p.epoch.tolist(), p.target.tolist(), strict=True))}
    partner = np.array([key.get(t, -1) for t in zip(s.a.tolist(), s.epoch.tolist(), s.target.tolist(), strict=True)])
    paired = partner >= 0
    share = 1.0 / (1.0 / slow - 1.0 / medium.straight)
    both = p.weight[..., partner] > 0.0
    return replace(
        s,
        kind="range",
        z=np.where(paired, share * (s.z - p.z[..., partner]), 0.0),
        correction=np.where(paired, share * (s.correction - p.correction[..., partner]), 0.0),
        weight=np.where(paired & both, s.weight, 0.0),
    )
