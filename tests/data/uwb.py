"""Reader of `util_uwb_tdoa`: windows of indoor UWB range differences, each one epoch of a free target.

Windows are 0.1 s long (TDOA3, where pairs are rarer: 0.3 s) and centred at every half second of a flight in which the tag
is higher than 0.5 m. The file's `rdiff_m` is |tag - anchor_b| - |tag - anchor_a|, so a row is optloc's tdoa, r_a - r_b,
with a and b exchanged.

Noise. A row is off by 0.22 m (F01) or 0.19 m (F03; robust spread in the set's README), but not independently of the
other rows of its window: the rows of one pair repeat within 0.05 m (robust; 0.11 m rms in F01, as the tails are heavy
and the tag moves by up to 0.1 m), whereas their means scatter by 0.20 m (F01) and 0.18 m (F03) from window to window.
The means of neighbouring pairs are correlated, by -0.9 to 0: what lasts for a window is mostly an error of each
anchor's arrival (antenna pattern, multipath), which enters its two pairs with opposite signs. Hence

    R = 0.10^2 I + 0.14^2 D D',       D = +1 at a, -1 at b,

with 0.14 = 0.20 / sqrt(2); its diagonal, (0.22 m)^2 for two arrivals and a row, is the spread of the README. That no
plausible fix is 5 sigma off does not hang on the numbers: it holds for 0.06 to 0.15 m a row and 0.14 to 0.17 m an
arrival. At 0.10 m a row the chi-square rejects 26 % (F01) and 39 % (F03) of the windows, which is what heavy tails do.
The only two fixes that are 5 sigma off, of F03, rest on one value wrong by 26 or 27 m, and p says so.

With `shared=False` rows are independent with 0.2 m: this is the loss of the README's table, but its covariance averages
over some 40 rows an error that does not average. It says 0.07 m where 0.18 m is the truth, and one plausible fix in
five is then more than 5 of its own sigma off.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from data.windows import Window, Windows, windowed

from optloc import Motion, Noise, Problem, assemble, measured
from optloc.noise import Block, group

ROW, ARRIVAL, INDEPENDENT = 0.10, 0.14, 0.2
STEP, AIRBORNE = 0.5, 0.5
WIDTH = {"TDOA2": 0.1, "TDOA3": 0.3}


def load(folder: Path, flight: str, *, shared: bool = True) -> Windows:
    """Return the windows of one flight; `shared`: with the errors that a window's rows share through their anchors."""
    flights = pd.read_csv(folder / "flights.csv").set_index("flight")
    anchors = pd.read_csv(folder / "stations.csv").sort_values("anchor")
    anchors = anchors[anchors["session"] == flights.loc[flight, "session"]]
    truth = pd.read_csv(folder / "truth.csv").query("flight == @flight")
    rows = pd.read_csv(folder / "tdoa.csv").query("flight == @flight").sort_values("t_s", kind="stable")
    stations = anchors[["x_m", "y_m", "z_m"]].to_numpy()
    width = WIDTH[str(flights.loc[flight, "mode"])]
    rows, at = windowed(rows, truth, np.arange(0.0, truth["t_s"].max() + 0.01, STEP), width)
    rows = rows[at[rows["window"], 2] > AIRBORNE]
    kept, epoch = np.unique(rows["window"], return_inverse=True)
    a, b, z = rows["anchor_b"].to_numpy(), rows["anchor_a"].to_numpy(), rows["rdiff_m"].to_numpy()
    places = [np.flatnonzero(epoch == k) for k in range(len(kept))]
    covariances = [_covariance(a[i], b[i], len(stations), shared=shared) for i in places]
    windows = tuple(Window(a[i], b[i], z[i], r, at[k]) for i, r, k in zip(places, covariances, kept, strict=True))
    problem = assemble(
        stations,
        measured("tdoa", z, a=a, b=b, sigma=INDEPENDENT, epoch=epoch),
        times=STEP * kept,
        motions=(Motion(span="epoch"),),
    )
    if shared:
        problem = replace(problem, noise=_noise(places, covariances))
    return Windows(f"{flight}{'' if shared else ', independent rows'}", stations, windows, problem)


def course(
    folder: Path, flight: str, width: float, *, airborne: bool = True, until: float = np.inf
) -> tuple[Problem, np.ndarray]:
    """Return a flight as one run of windows next to each other, at the mean time of their rows, and the truth there.

    `airborne`: from the first to the last time that the tag is higher than 0.5 m.
    """
    flights = pd.read_csv(folder / "flights.csv").set_index("flight")
    anchors = pd.read_csv(folder / "stations.csv").sort_values("anchor")
    stations = anchors[anchors["session"] == flights.loc[flight, "session"]][["x_m", "y_m", "z_m"]].to_numpy()
    truth = pd.read_csv(folder / "truth.csv").query("flight == @flight")
    rows = (
        pd.read_csv(folder / "tdoa.csv").query("flight == @flight and t_s < @until").sort_values("t_s", kind="stable")
    )
    if airborne:
        high = truth.loc[truth["z_m"] > AIRBORNE, "t_s"]
        rows = rows[rows["t_s"].between(high.min(), high.max())]
    _, epoch = np.unique(np.floor(rows["t_s"] / width), return_inverse=True)
    times = np.bincount(epoch, rows["t_s"]) / np.bincount(epoch)
    a, b = rows["anchor_b"].to_numpy(), rows["anchor_a"].to_numpy()
    problem = assemble(
        stations,
        measured("tdoa", rows["rdiff_m"].to_numpy(), a=a, b=b, sigma=INDEPENDENT, epoch=epoch),
        times=times,
        motions=(Motion(span="epoch"),),
    )
    places = [np.flatnonzero(epoch == k) for k in range(len(times))]
    noise = _noise(places, [_covariance(a[i], b[i], len(stations), shared=True) for i in places])
    at = np.stack([np.interp(times, truth["t_s"], truth[c]) for c in ("x_m", "y_m", "z_m")], axis=-1)
    return replace(problem, noise=noise), at


def _covariance(a: np.ndarray, b: np.ndarray, stations: int, *, shared: bool) -> np.ndarray:
    if not shared:
        return INDEPENDENT**2 * np.eye(len(a))
    design = np.eye(stations)[a] - np.eye(stations)[b]
    return ROW**2 * np.eye(len(a)) + ARRIVAL**2 * design @ design.T


def _noise(places: list[np.ndarray], covariances: list[np.ndarray]) -> Noise:
    return group([Block(rows[None], covariance[None]) for rows, covariance in zip(places, covariances, strict=True)])
