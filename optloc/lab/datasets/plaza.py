"""Radio ranges of a mower, in the plane, cut into windows. Each window is one epoch of a free target.

Windows are 1.5 s long, and centred at every 3 s from 2 s after the first range. The 155 windows with ranges to at least
3 beacons are kept. The true motion within a window is removed. The known `correction` of a row is the true range at the
row's time minus the true range at the window's centre.

The ranges have four forms. Rows are independent, and their sigma is the rms of all residuals:

- "raw": as measured; 3.0 m, of which 2.8 m are a mean, as ranges are 7 % too long;
- "offset": less the mean residual of each beacon; 1.15 m;
- "affine": corrected by an affine fit of the residuals of each beacon; 0.53 m;
- "scaled": as measured, for estimates of the scale, with the sigma of "affine".
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from optloc.lab.datasets.reading import Window, Windows, along, choose, cut_windows, places, table
from optloc.problem import Array, Motion, Problem, assemble, measured

# Metres: the rms of the residuals at the truth after each calibration, see above.
SIGMA = {"raw": 3.0, "offset": 1.15, "affine": 0.53, "scaled": 0.53}
# Seconds: windows do not overlap, and the first window is within the data. At 1.7 m/s the mower moves by up to 2.5 m in
# a window; the correction by the truth removes this motion.
STEP, WIDTH, LEAD = 3.0, 1.5, 2.0
LEAST = 3  # beacons that determine a position in the plane; two leave a mirror image


def dataset(folder: Path, *, form: str = "raw") -> tuple[Problem, Array]:
    """Return the windows as epochs of one problem, and the truth (k, 2), metres."""
    data = load(folder, form)
    return data.problem, data.truth


def load(folder: Path, form: str) -> Windows:
    """Return the windows of the set; `form` is "raw", "offset", "affine" or "scaled", see the module."""
    import pandas as pd

    sigma = SIGMA[choose(form, SIGMA, "form")]
    beacons, truth = table(folder, "stations"), table(folder, "truth")
    rows = table(folder, "ranges").sort_values("t_s", kind="stable")
    stations = places(beacons)
    a = pd.Index(beacons["beacon"]).get_indexer(rows["beacon"])
    distance = np.linalg.norm(along(rows["t_s"].to_numpy(), truth) - stations[a], axis=1)
    rows = rows.assign(a=a, distance=distance, z=_calibrate(form, rows["range_m"].to_numpy(), distance, a))
    # Centres of the windows. Rows outside of all windows are dropped, and so are windows with few beacons.
    times = np.arange(rows["t_s"].iloc[0] + LEAD, truth["t_s"].iloc[-1], STEP)
    rows, centres = cut_windows(rows, times, WIDTH), along(times, truth)
    rows = rows[rows.groupby("window")["a"].transform("nunique") >= LEAST]
    kept, epoch = np.unique(rows["window"], return_inverse=True)
    a, z = rows["a"].to_numpy(), rows["z"].to_numpy()
    # True range at the row's time minus true range at the centre of its window.
    correction = rows["distance"].to_numpy() - np.linalg.norm(centres[rows["window"]] - stations[a], axis=1)
    inside = [np.flatnonzero(epoch == k) for k in range(len(kept))]
    windows = tuple(
        Window(a[i], None, (z - correction)[i], sigma**2 * np.eye(len(i)), centres[k])
        for i, k in zip(inside, kept, strict=True)
    )
    problem = assemble(
        stations,
        measured("range", z, a=a, sigma=sigma, epoch=epoch, correction=correction),
        times=times[kept],
        motions=(Motion(span="epoch"),),
    )
    return Windows(f"Plaza {form}", stations, windows, problem)


def _calibrate(form: str, z: Array, distance: Array, a: Array) -> Array:
    """Return the ranges (n,) in metres, calibrated by the residuals of each beacon at the truth.

    `z` are the measured and `distance` the true ranges (n,) in metres, and `a` (n,) are the beacons of the rows.
    """
    if form in ("raw", "scaled"):
        return z
    calibrated = np.empty_like(z)
    for beacon in np.unique(a):
        rows = a == beacon
        excess = z[rows] - distance[rows]
        scale, offset = np.polyfit(distance[rows], excess, 1) if form == "affine" else (0.0, excess.mean())
        calibrated[rows] = (z[rows] - offset) / (1.0 + scale)
    return calibrated
