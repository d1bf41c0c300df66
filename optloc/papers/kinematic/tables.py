"""The tables of the page: printed, reproduced, bound and theory side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from optloc.papers.kinematic import printed
from optloc.papers.kinematic.trials import Association, Score, theory
from optloc.papers.report import Table
from optloc.types import Array


@dataclass(frozen=True, slots=True)
class Line:
    """One line of table 1.

    Parameters
    ----------
    name : str
        Algorithm and motion.
    score : Score
        Errors.
    bound : float or None
        Bound of the mean error, metres; None where the model is wrong.
    seconds : float
        Computing time of one run of three targets, as a share of the batch.
    key : str, optional
        Which printed line it is.
    """

    name: str
    score: Score
    bound: float | None
    seconds: float
    key: str | None = None


def km(value: float) -> str:
    """Return metres as kilometres: three decimals, fewer where they are many, a dash where there is none."""
    if not np.isfinite(value):
        return "–"
    size = 1e-3 * value
    return f"{size:.3f}" if size < 100.0 else f"{size:.3g}" if size < 1000.0 else f"{size:.0f}"


def share(value: float) -> str:
    """Return a share as per cent."""
    return f"{100.0 * value:.1f} %"


def errors(lines: Sequence[Line]) -> Table:
    """Return table 1 of the paper."""
    header = ("algorithm on motion", "printed", "reproduced", "standard error", "bound", "printed ms", "ms")
    rows = []
    for line in lines:
        known = line.key is not None
        rows.append(
            (
                line.name,
                f"{printed.ERROR[line.key]:.3f}" if line.key is not None else "",
                km(line.score.mean),
                km(line.score.spread),
                "–" if line.bound is None else km(line.bound),
                f"{printed.SECONDS[line.key]:.3f}" if known and line.key is not None else "",
                f"{1e3 * line.seconds:.3f}",
            )
        )
    note = (
        "Mean distance from the truth over runs, targets and steps 1 to 20, kilometres. The noise was chosen so that "
        "the first line fits, the interval so that CV on CA does; the other two lines are the test. The bound is that "
        "of the mean distance of a normal error with the covariance of Cramér and Rao. Times are of one run of three "
        "targets, of one epoch in the first line, ours as its share of the batch."
    )
    return Table("table-1", "Table 1: mean position error", header, tuple(rows), note)


def ratios(fix: Score, matched: Mapping[str, Score], steps: int) -> Table:
    """Return what is left of table 1 when its noise is divided out."""
    single = printed.ERROR["static"]
    rows = []
    for name, score in matched.items():
        order = 1 if name == "CV" else 2
        wanted = printed.ERROR[f"{name} on {name}"] / single
        rows.append((f"{name} / fix", f"{wanted:.3f}", f"{score.mean / fix.mean:.3f}", f"{theory(order, steps):.3f}"))
    note = (
        "A filter without process noise and with a loose prior fits a polynomial. The theory is the error of the end "
        "point of a line or a parabola through k equally good points over that of one point, averaged over "
        f"k = 2 to {steps + 1}. It knows nothing of the geometry."
    )
    return Table(
        "ratios", "Error over that of a single fix", ("", "printed", "reproduced", "theory"), tuple(rows), note
    )


def efficiency(found: Mapping[str, tuple[Score, Score, Score, float]]) -> Table:
    """Return last-step errors of filter, iterated filter and batch beside the bound."""
    header = ("model on its own motion", "EKF", "IEKF", "batch ML", "bound", "EKF / bound", "NEES of the EKF")
    rows = []
    for name, (plain, iterated, whole, bound) in found.items():
        lengths = (km(plain.last), km(iterated.last), km(whole.last), km(bound))
        rows.append((name, *lengths, f"{plain.last / bound:.3f}", f"{plain.nees[..., -1].mean():.2f}"))
    note = (
        "Root mean square error at the last step, kilometres, and the posterior Cramér-Rao bound. A NEES of 2 means "
        "that the covariance is right. Nothing is left here for a smoother or a particle filter."
    )
    return Table("efficiency", "How good the filters are at the last step", header, tuple(rows), note)


def models(found: Mapping[str, Sequence[Score]], motions: Sequence[str]) -> Table:
    """Return mean errors of filters on several motions."""
    header = ("filter", *motions)
    rows = tuple((name, *(km(score.mean) for score in scores)) for name, scores in found.items())
    note = (
        "Mean error, kilometres. In the last column targets fly straight and begin to accelerate half way: models "
        "side by side then hold on to the past, models that interact do not."
    )
    return Table("models", "Right and wrong models", header, rows, note)


def choice(found: Mapping[str, Array], steps: Sequence[int]) -> Table:
    """Return how often the likelihood prefers the right model."""
    header = ("motion", *(f"step {step}" for step in steps))
    rows = tuple((name, *(f"{100.0 * shares[step - 1]:.1f}" for step in steps)) for name, shares in found.items())
    note = "Per cent of runs in which the right one of static, CV and CA has the largest likelihood so far."
    return Table("choice", "Choice of the model by likelihood", header, rows, note)


def association(found: Mapping[str, Association]) -> Table:
    """Return the association test."""
    header = ("motion", "rule", "mean error", "median NEES", "mean NEES", "lost")
    rows = []
    for motion, test in found.items():
        for rule, score in test.scores.items():
            last = score.nees[..., -1]
            mean = float(last.mean())
            rows.append(
                (
                    motion,
                    rule,
                    km(score.mean),
                    _size(float(np.median(last))),
                    _size(mean),
                    share(score.lost),
                )
            )
    note = (
        "Kilometres; NEES at the last step, 2 on average where the covariance is right (its median is then 1.39). A "
        "row is seen with probability 0.7 and there are 2 false ones in every channel and epoch. *Lost* ends more than "
        "10 km from the truth."
    )
    return Table("association", "Rows without names", header, tuple(rows), note)


def _size(value: float) -> str:
    return f"{value:.2f}" if abs(value) < 100.0 else f"{value:.2g}".replace("e+0", "e").replace("e+", "e")


def wrong(rows: Sequence[tuple[str, str, str, str]]) -> Table:
    """Return what the printed equations do beside their corrected form."""
    header = ("equation", "measured", "as printed", "corrected")
    return Table("equations", "What the printed equations do", header, tuple(rows))
