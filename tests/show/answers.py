"""Fixes of every kind of answer, on Earth and in plain frames, for the tests of the renderings."""

from dataclasses import replace
from functools import cache

import numpy as np
from show.ranging import ENU, PLACES, ranged, unbounded

from optloc import assemble, measured, solve
from optloc.base.records import join

CORNER = np.array([[0.0, 0.0, 0.0], [900.0, 0.0, 0.0], [0.0, 900.0, 0.0]])
TARGET = np.array([300.0, 400.0, 200.0])


def _solved(places, z, frame, sigma=1.0, kind="range"):
    rows = measured(kind, z, a=np.arange(len(places)), sigma=sigma)
    return solve(assemble(places, rows) if frame is None else assemble(places, rows, frame=frame))


@cache
def singles():
    """Return single fixes by name: `ok`, ambiguous, misfit and unbounded, and one bearing alone."""
    out = {"ok on Earth": ranged()[1], "unbounded on Earth": unbounded()}
    far = np.linalg.norm(TARGET - CORNER, axis=1)
    four = np.linalg.norm(TARGET[:2] - PLACES, axis=1)
    for place, frame in (("on Earth", ENU), ("in a plain frame", None)):
        out |= {
            f"ambiguous {place}": _solved(CORNER, far, frame),
            f"misfit {place}": _solved(PLACES, four + np.array([0.0, 60.0, 0.0, 0.0]), frame),
            f"one bearing {place}": _solved(PLACES[:1], [0.3], frame, 1e-3, "azimuth"),
        }
    return out | {"ok in a plain frame": _solved(PLACES, four, None)}


@cache
def batch():
    """Return 25 fixes with labels: `ok` and unbounded ones in turn."""
    parts = [(ranged()[1] if i % 5 else unbounded()).flat() for i in range(25)]
    return replace(join(parts, 25), labels=np.array([f"event {i}" for i in range(25)], dtype=object))


@cache
def states():
    """Return one fix of two targets."""
    rows = [
        measured("range", np.linalg.norm(place - PLACES, axis=1), a=np.arange(4), sigma=1.0, target=i)
        for i, place in enumerate(np.array([[300.0, 400.0], [700.0, 200.0]]))
    ]
    from optloc import Motion

    return solve(assemble(PLACES, *rows, motions=(Motion(), Motion()), frame=ENU))
