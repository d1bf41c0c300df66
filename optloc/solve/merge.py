"""Put better fixes of some problems into the fixes of all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optloc.fix import Alternatives, Fix, Stage
from optloc.types import Array

_NAMES = "x cov code reason certificate cost dof weights active local explanations".split()


def merged(fix: Fix, items: Array, other: Fix, stage: Stage) -> Fix:
    """Return a flat batch of fixes with some of them replaced by others, and one more stage.

    Parameters
    ----------
    fix : Fix
        N fixes.
    items : int array (q,)
        Which are replaced.
    other : Fix
        The q fixes that take their place.
    stage : Stage
        What was done.
    """
    width = max(fix.alternatives.gap.shape[1], other.alternatives.gap.shape[1])
    mine, theirs = _padded(fix.alternatives, width), _padded(other.alternatives, width)
    mine.x[items], mine.gap[items] = theirs.x, theirs.gap
    changed: dict[str, Array] = {}
    for name in _NAMES:
        if (old := getattr(fix, name)) is not None:
            changed[name] = np.array(old)
            changed[name][items] = getattr(other, name)
    return replace(fix, alternatives=mine, stages=(*fix.stages, stage), **changed)  # type: ignore[arg-type]


def stacked(fixes: Sequence[Fix]) -> Fix:
    """Return single fixes of one layout as a batch."""
    width = max(len(fix.alternatives.gap) for fix in fixes)
    every = [_padded(fix.flat().alternatives, width) for fix in fixes]
    others = Alternatives(np.concatenate([a.x for a in every]), np.concatenate([a.gap for a in every]))
    arrays = {name: np.stack([getattr(fix, name) for fix in fixes]) for name in _NAMES if _has(fixes, name)}
    return replace(fixes[0], alternatives=others, **arrays)  # type: ignore[arg-type]


def _has(fixes: Sequence[Fix], name: str) -> bool:
    return all(getattr(fix, name) is not None for fix in fixes)


def _padded(alternatives: Alternatives, width: int) -> Alternatives:
    more = width - alternatives.gap.shape[1]
    x = np.pad(alternatives.x, ((0, 0), (0, more), (0, 0)), constant_values=np.nan)
    return Alternatives(x, np.pad(alternatives.gap, ((0, 0), (0, more)), constant_values=np.inf))
