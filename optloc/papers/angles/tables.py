"""The tables: printed value, reproduced value and bound side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from optloc.papers.angles import printed
from optloc.papers.angles.filters import Curve, Lost, Reading
from optloc.papers.angles.fits import Rays
from optloc.papers.angles.scenario import REPAIRED
from optloc.papers.report import Table
from optloc.types import Array

_PARTS = ("position, m", "velocity, m/s", "acceleration, m/s²")
_FAR = 1e6


def short(value: float) -> str:
    """Return a number with three significant digits, "lost" where it is not finite or beyond 1000 km."""
    if not np.isfinite(value) or value > _FAR:
        return "lost"
    if value == 0.0 or value >= 1e2:
        return f"{value:.0f}"
    return f"{value:.2e}" if value < 1e-3 else f"{value:.{2 - int(np.floor(np.log10(value)))}f}"


def percent(share: float) -> str:
    """Return a share as per cent."""
    return f"{100.0 * share:.1f} %"


def straight(curves: Sequence[Curve]) -> Table:
    """Return the errors of simulation 1 over the whole track."""
    lines = [("printed", *(short(v) for v in printed.STRAIGHT))]
    lines += [(c.label, *(short(v) for v in c.total())) for c in curves]
    note = (
        "Root mean square over 50 s. The start is the truth with acceleration zero, of standard deviations 0.1 m, "
        "0.1 m/s and 0.2 m/s². The posterior bound averages over tracks of the model, with the variance that it has "
        "without acceleration; this track is smoother than most of them. The last row is the bound of the one track "
        "whose acceleration is known to be constant."
    )
    return Table("simulation-1", "Simulation 1: errors of the filter", ("", *_PARTS), tuple(lines), note)


def winding(curves: Sequence[Curve]) -> Table:
    """Return the errors of simulation 2, over the whole track and without its first ten seconds."""
    lines = [("0 to 50 s", "printed", *(short(v) for v in printed.WINDING))]
    for first in (0, 10):
        lines += [(f"{first} to 50 s", c.label, *(short(v) for v in c.total(first))) for c in curves]
    note = (
        "a_max 30. Started at rest with standard deviations of 0.1 m, 2 m/s and 1 m/s²; or by the fit of an "
        "acceleration to the first three seconds, without a guess, and scored from the fourth on."
    )
    return Table("simulation-2", "Simulation 2: errors of the filter", ("scored", "", *_PARTS), tuple(lines), note)


def circles(found: Mapping[float, Sequence[Curve]], snapshot: Curve) -> Table:
    """Return the position errors of the repaired simulation 3."""
    lines = [("–", "bound of every second by itself", *(short(v) for v in snapshot.phases(REPAIRED)))]
    for limit, curves in found.items():
        lines += [(f"{limit:g}", c.label, *(short(v) for v in c.phases(REPAIRED))) for c in curves]
    header = ("a_max", "", "straight", "circle", "straight again")
    note = (
        "Position errors in metres; the first 20 s do not count. 74 m/s² is the acceleration in the circle. All "
        "filters start at the fix of the first second."
    )
    return Table("simulation-3", "Simulation 3, repaired", header, tuple(lines), note)


def readings(found: Sequence[Reading]) -> Table:
    """Return the position errors of simulation 3 as printed."""
    lines = []
    for each in found:
        pairs = [cell for pair in zip(each.error, each.bound, strict=True) for cell in pair]
        lines.append(
            (each.scenario.name.removeprefix("as printed, in "), f"{each.limit:g}", *(short(v) for v in pairs))
        )
    header = ("reading", "a_max", "straight", "bound", "circle", "bound", "straight again", "bound")
    note = "Metres; the first 20 s do not count; the bound is the posterior one."
    return Table("readings", "Simulation 3 as printed, in two readings", header, tuple(lines), note)


def starts(found: Sequence[Lost]) -> Table:
    """Return the shares of lost tracks."""
    header = ("start", "a_max", "single step", "converged", "modified gain", "modified covariance")
    lines = []
    for each in found:
        start = f"{each.sigma:g} m" if each.sigma else "fit of 3 s"
        lines.append((start, f"{each.limit:g}", *(percent(each.share[n]) for n in ("ekf", "iekf", "mgekf", "mvekf"))))
    note = (
        "Share of the tracks of simulation 1 that end further than 10 m from the truth. Starts are drawn around the "
        "truth with the deviation given, 0.1 m/s and 0.2 m/s²; the last row starts by a fit without a guess. The "
        "single step is the update of the paper."
    )
    return Table("starts", "A start on the line through both stations", header, tuple(lines), note)


def clamps(found: Mapping[str, float]) -> Table:
    """Return the shares of lost tracks with and without a clamped variance."""
    lines = tuple((name, percent(share)) for name, share in found.items())
    note = "Simulation 1 from starts of 3 m with a_max 0.3; the acceleration is 0.2 m/s². Single step."
    return Table("clamp", "The variance near the limit of the acceleration", ("variance", "lost"), lines, note)


def wholes(found: Sequence[tuple[str, Array]], bound: Array) -> Table:
    """Return the errors at the end of simulation 1 of fits to the whole track."""
    lines = [("Cramér-Rao bound", *(short(v) for v in bound))]
    lines += [(name, *(short(v) for v in error)) for name, error in found]
    note = "Root mean square at 50 s. The fits know that the acceleration is constant and have neither start nor prior."
    return Table("whole-track", "Simulation 1: fits to the whole track", ("", *_PARTS), tuple(lines), note)


def rays(found: Sequence[Rays]) -> Table:
    """Return bias and error of fixes of a target that stays."""
    header = ("stations", "noise", "fix", "bias", "error", "bound")
    names = ("plain", "weighted", "instrumental", "maximum likelihood")
    lines = [
        (f"{each.stations}", f"{1e3 * each.sigma:g} mrad", name, *(short(v) for v in (*values, each.bound)))
        for each in found
        for name, values in zip(names, each.fixes, strict=True)
    ]
    note = (
        "Target at (-10, 50, 10) km; metres; the bias is known to the error over the root of the number of trials. Two "
        "stations are those of simulation 3, the others stand between them in two rows."
    )
    return Table("rays", "A target that stays: few rays and many", header, tuple(lines), note)
