"""Range differences of a quadrotor among anchors, cut into windows. Each window is one epoch of a free target.

Windows are 0.1 s long, or 0.3 s in TDOA3, where the anchors transmit in turn. They are centred at every half second of
a flight in which the tag is higher than 0.5 m. The file's `rdiff_m` is |tag - anchor_b| - |tag - anchor_a|. A row is
optloc's tdoa, r_a - r_b, with a and b exchanged.

Noise. The error of a row is 0.22 m (F01) or 0.19 m (F03): the robust spread that comes with the set. The errors of a
window are not independent. Rows of one pair repeat within 0.05 m (robust; 0.11 m rms in F01, as the tails are heavy and
the tag moves by up to 0.1 m). Their means scatter by 0.20 m (F01) and 0.18 m (F03) from window to window. The means of
neighbouring pairs are correlated, by -0.9 to 0. So the error that lasts for a window is mostly an error of each
anchor's arrival (antenna pattern, multipath). It enters the two pairs of the anchor with opposite signs. Hence

    R = 0.10^2 I + 0.14^2 D D',       D = +1 at a, -1 at b,

with 0.14 = 0.20 / sqrt(2). The diagonal of R, (0.22 m)^2 for two arrivals and a row, is the robust spread. No plausible
fix is 5 sigma off. This holds for 0.06 to 0.15 m a row and 0.14 to 0.17 m an arrival. At 0.10 m a row the chi-square
test rejects 26 % (F01) and 39 % (F03) of the windows, because the tails are heavy. Only two fixes of F03 are 5 sigma
off. Each has one value that is wrong by 26 or 27 m, and a small p-value.

With `shared=False` rows are independent with 0.2 m. This is plain least squares, but its covariance averages over some
40 rows an error that does not average. The covariance claims 0.07 m while the true error is 0.18 m. One plausible fix
in five is then more than 5 of its claimed sigma off.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from optloc.lab.datasets.reading import Window, Windows, along, choose, cut_windows, places, table
from optloc.problem import Array, Block, InvalidProblem, Motion, Noise, Problem, assemble, group, measured

if TYPE_CHECKING:
    import pandas as pd

# Metres: error of a row, error of an anchor's arrival in a window, and error of a row if all rows are independent.
ROW, ARRIVAL, INDEPENDENT = 0.10, 0.14, 0.2
STEP, AIRBORNE = 0.5, 0.5  # seconds from window to window; metres above which the tag counts as flying
# Seconds: some 40 rows of the eight pairs of neighbours; in TDOA3, some 60 rows of 35 pairs.
WIDTH = {"TDOA2": 0.1, "TDOA3": 0.3}


def dataset(folder: Path, *, flight: str = "F01", shared: bool = True) -> tuple[Problem, Array]:
    """Return the windows of a flight as epochs of one problem, and the true positions (k, 3), metres.

    With `shared`, rows of a window share the errors of their anchors; otherwise rows are independent.
    """
    data = load(folder, flight, shared=shared)
    return data.problem, data.truth


def load(folder: Path, flight: str, *, shared: bool = True) -> Windows:
    """Return the windows of one flight; with `shared`, rows of a window share the errors of their anchors."""
    width, stations, rows, truth = _flight(folder, flight)
    # 0.01 s: a flight that ends at a half second has a window there
    times = np.arange(0.0, truth["t_s"].max() + 0.01, STEP)
    rows, centres = cut_windows(rows, times, width), along(times, truth)
    rows = rows[centres[rows["window"], 2] > AIRBORNE]
    kept, epoch = np.unique(rows["window"], return_inverse=True)
    # Exchanged, because the file subtracts the range of anchor_a.
    a, b, z = rows["anchor_b"].to_numpy(), rows["anchor_a"].to_numpy(), rows["rdiff_m"].to_numpy()
    inside = [np.flatnonzero(epoch == k) for k in range(len(kept))]
    covariances = [_covariance(a[i], b[i], len(stations), shared=shared) for i in inside]
    windows = tuple(
        Window(a[i], b[i], z[i], covariance, centres[k])
        for i, covariance, k in zip(inside, covariances, kept, strict=True)
    )
    problem = _problem(stations, a, b, z, epoch, STEP * kept)
    if shared:
        problem = replace(problem, noise=_noise(inside, covariances))
    return Windows(f"{flight}{'' if shared else ', independent rows'}", stations, windows, problem)


def course(
    folder: Path, flight: str, width: float, *, airborne: bool = True, until: float = np.inf
) -> tuple[Problem, Array]:
    """Return a flight as one run of adjacent windows, and the true positions (k, 3) in metres.

    Both are at the mean times of the windows. With `airborne`, the run covers the first to the last time at which the
    tag is higher than 0.5 m. `width` is the length of a window, and rows before `until` are used; both are in seconds.
    """
    _, stations, rows, truth = _flight(folder, flight)
    rows = rows[rows["t_s"] < until]
    if airborne:
        flying = truth.loc[truth["z_m"] > AIRBORNE, "t_s"]
        rows = rows[rows["t_s"].between(flying.min(), flying.max())]
    # Adjacent windows that contain rows, at the mean time of the rows.
    _, epoch = np.unique(np.floor(rows["t_s"] / width), return_inverse=True)
    times = np.bincount(epoch, rows["t_s"]) / np.bincount(epoch)
    a, b = rows["anchor_b"].to_numpy(), rows["anchor_a"].to_numpy()  # exchanged, as in `load`
    problem = _problem(stations, a, b, rows["rdiff_m"].to_numpy(), epoch, times)
    inside = [np.flatnonzero(epoch == k) for k in range(len(times))]
    noise = _noise(inside, [_covariance(a[i], b[i], len(stations), shared=True) for i in inside])
    return replace(problem, noise=noise), along(times, truth)


def _flight(folder: Path, flight: str) -> tuple[float, Array, pd.DataFrame, pd.DataFrame]:
    """Return the window's width in seconds, the anchors (s, 3) in metres, the rows by time, and the truth."""
    flights = table(folder, "flights").set_index("flight")
    mode = str(flights.loc[choose(flight, flights.index, "flight"), "mode"])
    if mode not in WIDTH:
        names = ", ".join(flights.index[flights["mode"].isin(list(WIDTH))])
        raise InvalidProblem(f"the flight {flight!r} has ranges, not differences", "flight", f"use {names}")
    anchors = table(folder, "stations").sort_values("anchor")
    stations = places(anchors[anchors["session"] == flights.loc[flight, "session"]])
    truth, rows = (found[found["flight"] == flight] for found in (table(folder, "truth"), table(folder, "tdoa")))
    return WIDTH[mode], stations, rows.sort_values("t_s", kind="stable"), truth


def _problem(stations: Array, a: Array, b: Array, z: Array, epoch: Array, times: Array) -> Problem:
    """Return the problem of range differences z (m,) in metres, with a free target in each epoch.

    `a` and `b` (m,) are the anchors of the rows, and `times` the seconds of the epochs.
    """
    rows = measured("tdoa", z, a=a, b=b, sigma=INDEPENDENT, epoch=epoch)
    return assemble(stations, rows, times=times, motions=(Motion(span="epoch"),))


def _covariance(a: Array, b: Array, stations: int, *, shared: bool) -> Array:
    """Return the covariance (m, m) of the rows of a window, m^2; `stations` is the number of anchors."""
    if not shared:
        return INDEPENDENT**2 * np.eye(len(a))
    # The error of an anchor enters all its rows of the window, with the sign of the anchor in the difference.
    design = np.eye(stations)[a] - np.eye(stations)[b]
    return ROW**2 * np.eye(len(a)) + ARRIVAL**2 * design @ design.T


def _noise(inside: list[Array], covariances: list[Array]) -> Noise:
    """Return the noise of all windows; `inside` are the row numbers of each window, `covariances` their covariances."""
    return group([Block(rows[None], covariance[None]) for rows, covariance in zip(inside, covariances, strict=True)])
