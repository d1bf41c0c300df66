"""The tables: the four filters from fixes and from afar, what the height is worth, and satellites that move."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from optloc.papers.report import Table
from optloc.papers.satellites.trials import Run
from optloc.types import Array

NAMES = {
    "ekf": "EKF",
    "iekf": "IEKF",
    "mgekf": "MGEKF",
    "mvekf": "MVEKF",
    "quartic + ekf": "EKF from two fixes",
}
"""How tables and figures call the filters."""

STEPS = (1, 10, 50, 100, 200)
"""Steps at which the filters are looked at."""


def metres(value: float) -> str:
    """Return metres with a sensible number of digits; kilometres are marked."""
    if value >= 1e4:
        return f"{value / 1e3:.0f} km"
    return f"{value:.1f}" if value < 1e3 else f"{value:.0f}"


def fixed(found: Mapping[str, Run], bound: Array) -> Table:
    """Return the filters started by fixes; the bound is (steps,), metres."""
    steps = [step for step in STEPS if step <= len(bound)]
    plain = found["ekf"].position
    lines = []
    for name, run in found.items():
        apart = np.linalg.norm(run.position - plain, axis=-1)[:, 10:].max()
        share = f"{run.error.mean(0)[-1] / 1e3:.4f} %"
        lines.append((NAMES[name], *(metres(run.rms[step - 1]) for step in steps), share, f"{apart:.2f}"))
    lines.append(("posterior bound", *(metres(bound[step - 1]) for step in steps), "–", "–"))
    last = f"mean error at {len(bound)}, of 100 km"
    header = ("filter", *(f"step {step}, m" for step in steps), last, "most from EKF after step 10, m")
    note = (
        "Root mean square errors. The paper's curves of the four filters lie far apart; from fixes they are one curve."
    )
    return Table("fixed", "Started by the fixes of the first two epochs", header, tuple(lines), note)


def starts(found: Mapping[float, tuple[Mapping[str, Run], Array]], near: float = 1e3) -> Table:
    """Return the filters after starts that are far off, by the standard deviation of each coordinate, metres."""
    lines = []
    for width, (runs, bound) in found.items():
        for name, run in runs.items():
            last = run.error[:, -1]
            figures = (
                metres(float(run.rms[-1])),
                metres(float(np.median(last))),
                metres(float(run.claimed[:, -1].mean())),
            )
            lines.append(
                (
                    f"{width / 1e3:.0f} km",
                    NAMES[name],
                    *figures,
                    f"{100 * (last < near).mean():.1f} %",
                    metres(bound[-1]),
                )
            )
    header = ("start error", "filter", "rms, m", "median, m", "claimed, m", "within 1 km", "posterior bound, m")
    note = (
        "*Claimed* is the root of the trace of the filter's own covariance. The last filter of each group takes no "
        "start: it begins from the fixes of the first two epochs of the same data."
    )
    count = len(next(iter(found.values()))[1])
    return Table("starts", f"Far starts, after {count} steps", header, tuple(lines), note)


def pairs(found: Mapping[float, tuple[Mapping[str, Run], Array]]) -> Table:
    """Return in how many runs the modified covariance did better than its rivals at the end."""
    lines = []
    for width, (runs, _) in found.items():
        own = runs["mvekf"].error[:, -1]
        better = [f"{100 * (own < runs[rival].error[:, -1]).mean():.0f} %" for rival in ("ekf", "iekf", "mgekf")]
        lines.append((f"{width / 1e3:.0f} km", *better))
    header = ("start error", "better than EKF", "better than IEKF", "better than MGEKF")
    return Table("pairs", "Runs in which the MVEKF ends nearer to the truth", header, tuple(lines))


def heights(found: Mapping[str, Run]) -> Table:
    """Return errors and claims of the IEKF from fixes, by what is known of the height."""
    lines = []
    for name, run in found.items():
        steps = [step for step in (1, 100, 200) if step <= run.error.shape[1]]
        cells = [f"{metres(run.rms[s - 1])} ({metres(run.claimed[:, s - 1].mean())})" for s in steps]
        lines.append((name, *cells))
    header = ("height", *(f"step {step}: rms (claimed), m" for step in steps))
    note = (
        "A wrong height is a constant. As white noise it seems to average out; as a state with a prior it stays in the "
        "covariance. The height of the sea is known to ten metres."
    )
    return Table("heights", "What the height is worth", header, tuple(lines), note)


def moving(found: Mapping[str, tuple[Run, Array]], still: Array) -> Table:
    """Return errors and bounds with satellites that fly, by heading, beside the bound (steps,) of those that stay."""
    steps = [step for step in (50, 100, 200) if step <= len(still)]
    lines = [("as printed: they stay", *(f"– ({metres(still[s - 1])})" for s in steps))]
    for name, (run, bound) in found.items():
        lines.append((name, *(f"{metres(run.rms[s - 1])} ({metres(bound[s - 1])})" for s in steps)))
    header = ("heading of the satellites", *(f"step {step}: rms (bound), m" for step in steps))
    note = "They fly at 7.4 km/s; the geometry is soon worse than that of the printed ones."
    return Table("moving", "Satellites that move, IEKF from two fixes", header, tuple(lines), note)


def one_shot(bounds: Mapping[str, float], far: Mapping[float, float]) -> Table:
    """Return bounds of a single fix, metres: by noise, and by degrees from the point below the satellites."""
    lines = [(name, metres(value)) for name, value in bounds.items()]
    lines += [(f"{angle:.0f}° from the point below, height known", metres(value)) for angle, value in far.items()]
    note = "Root of the trace; over twelve bearings in the last rows."
    return Table("one-shot", "Bound of one fix", ("case", "bound, m"), tuple(lines), note)
