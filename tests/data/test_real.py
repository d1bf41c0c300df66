"""All shipped data sets in one table: fixes and tracks with stated and learnt noise. Writes docs/measured/real.md."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from data.windows import report
from monte_carlo.tables import ledger

from optloc import InvalidProblem, Problem, Status, datasets, solve
from optloc.lab.datasets import mrclam, plaza, uwb
from optloc.model_checks.elements import batch_of
from optloc.station_health.structure import with_estimated_noise
from optloc.tracking import polynomial, tracked

pytestmark = [pytest.mark.data, pytest.mark.full]

# Standard deviations beyond which an error is far, and the probability from which a fix is likely.
FAR, LIKELY = 5.0, 0.01
# A share may fall, and the far ones may rise, by this much before a guard fails: one or two fixes of a small set.
SLACK = 0.01


@dataclass(frozen=True)
class Counts:
    """Fixes of a set: their number, the number that is `ok`, that is likely, that is far, and errors in metres."""

    fixes: int
    ok: int
    likely: int
    far: int
    median: float
    from_truth: float

    @property
    def cells(self) -> tuple[str, ...]:
        share = f"{100.0 * self.ok / self.fixes:.1f} %"
        far = f"{self.far} of {self.likely}"
        return (str(self.fixes), share, far, f"{self.median:.3g}", f"{self.from_truth:.3g}")


def count(problem: Problem, truth: np.ndarray) -> Counts:
    """Return the counts of the fixes of a problem by `auto`, and the median error of descents from the truth."""
    batch = batch_of(problem)
    d, fix = batch.dimension, solve(batch).flat()
    place = np.broadcast_to(np.asarray(truth).reshape(-1, truth.shape[-1])[:, :d], fix.position.shape)
    error = fix.position - place
    cov = fix.gaussian()[1][:, :d, :d]
    good = (fix.code == Status.OK) & (fix.p_value > LIKELY)
    squared = np.einsum("ni,nij,nj->n", error[good], np.linalg.pinv(cov[good]), error[good])
    return Counts(
        len(error),
        int((fix.code == Status.OK).sum()),
        int(good.sum()),
        int((squared > FAR**2).sum()),
        float(np.nanmedian(np.linalg.norm(error, axis=1))),
        float(np.nanmedian(np.linalg.norm(_from_truth(batch, fix.x, place) - place, axis=1))),
    )


def _from_truth(batch: Problem, x: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the positions of descents that start at the truth; other unknowns start where the fix has them."""
    start = np.where(np.isfinite(x), x, 0.0)
    start[:, : place.shape[1]] = place
    return solve(batch, "lsr", start=start).flat().position


def learnt(problem: Problem) -> tuple[Problem, str]:
    """Return a problem with noise from its data, and the structure of the noise."""
    try:
        now, levels = with_estimated_noise(problem)
    except InvalidProblem:
        return problem, "not determined"
    return now, f"learnt: {levels.by}{'+epoch' if levels.common else ''}"


@dataclass(frozen=True)
class Guard:
    """Options of a set, and guards for stated and for learnt noise: least share `ok`, largest share of far fixes."""

    name: str
    options: dict[str, object]
    stated: tuple[float, float]
    learnt: tuple[float, float]


BEARINGS, BOTH, RANGES = ("azimuth",), ("azimuth", "range"), ("range",)
SETS = {
    "MRCLAM 1, bearings": Guard("mrclam", {"number": 1, "kinds": BEARINGS}, (0.82, 0.0), (0.99, 0.0)),
    "MRCLAM 2, bearings": Guard("mrclam", {"number": 2, "kinds": BEARINGS}, (0.87, 0.0), (0.93, 0.0)),
    "MRCLAM 5, bearings": Guard("mrclam", {"number": 5, "kinds": BEARINGS}, (0.70, 0.0), (0.95, 0.005)),
    "MRCLAM 1, bearings and ranges": Guard("mrclam", {"number": 1, "kinds": BOTH}, (1.0, 0.002), (1.0, 0.0)),
    "MRCLAM 2, bearings and ranges": Guard("mrclam", {"number": 2, "kinds": BOTH}, (0.97, 0.003), (0.97, 0.004)),
    "MRCLAM 5, bearings and ranges": Guard("mrclam", {"number": 5, "kinds": BOTH}, (0.99, 0.005), (0.99, 0.002)),
    "MRCLAM 1, ranges": Guard("mrclam", {"number": 1, "kinds": RANGES}, (0.65, 0.0), (0.68, 0.0)),
    "MRCLAM 2, ranges": Guard("mrclam", {"number": 2, "kinds": RANGES}, (0.52, 0.001), (0.54, 0.001)),
    "MRCLAM 5, ranges": Guard("mrclam", {"number": 5, "kinds": RANGES}, (0.20, 0.004), (0.26, 0.028)),
    "UWB F01": Guard("uwb", {"flight": "F01"}, (0.77, 0.0), (1.0, 0.0)),
    "UWB F02": Guard("uwb", {"flight": "F02"}, (0.17, 0.0), (0.76, 0.0)),
    "UWB F03": Guard("uwb", {"flight": "F03"}, (0.65, 0.0), (0.97, 0.0)),
    "UWB F04": Guard("uwb", {"flight": "F04"}, (0.30, 0.0), (0.69, 0.0)),
    "UWB F05": Guard("uwb", {"flight": "F05"}, (0.10, 0.0), (0.74, 0.0)),
    "UWB F06": Guard("uwb", {"flight": "F06"}, (0.57, 0.0), (0.89, 0.0)),
    "Plaza, raw": Guard("plaza", {"form": "raw"}, (0.90, 0.0), (0.98, 0.0)),
    "Plaza, offsets": Guard("plaza", {"form": "offset"}, (0.99, 0.0), (0.99, 0.0)),
    "Plaza, affine": Guard("plaza", {"form": "affine"}, (1.0, 0.0), (1.0, 0.0)),
    "STAR-loc R1, nominal": Guard("starloc", {"run": "R1", "attitude": "nom"}, (0.89, 0.71), (0.95, 0.01)),
    "STAR-loc R1, calibrated": Guard("starloc", {"run": "R1", "attitude": "cal"}, (0.91, 0.14), (0.95, 0.01)),
    "STAR-loc R2, nominal": Guard("starloc", {"run": "R2", "attitude": "nom"}, (0.07, 1.0), (0.04, 0.0)),
    "STAR-loc R2, calibrated": Guard("starloc", {"run": "R2", "attitude": "cal"}, (0.66, 0.23), (0.76, 0.04)),
    "airliners": Guard("adsb", {}, (0.97, 0.16), (0.98, 0.051)),
    "satellites K078": Guard("gnss", {"session": "K078"}, (1.0, 0.0), (1.0, 0.0)),
    "satellites N176": Guard("gnss", {"session": "N176"}, (1.0, 0.0), (1.0, 0.0)),
}


# Least share of `ok` scans of each flight.
FLOWN = {"F01": 0.97, "F02": 0.97, "F03": 0.97, "F04": 0.9, "F05": 0.97, "F06": 0.97}


@dataclass(frozen=True)
class TrackGuard:
    """A run of one target, the least share of `ok` scans, and the largest share of far ones among these."""

    read: Callable[[Path], tuple[Problem, np.ndarray]]
    ok: float
    far: float


def _course(flight: str) -> Callable[[Path], tuple[Problem, np.ndarray]]:
    return lambda folder: uwb.course(folder / "util_uwb_tdoa", flight, WINDOW)


def _robot(number: int, kinds: tuple[str, ...]) -> Callable[[Path], tuple[Problem, np.ndarray]]:
    return lambda folder: mrclam.dataset(folder / "mrclam_aoa2d", number=number, kinds=kinds)


def _mower(form: str) -> Callable[[Path], tuple[Problem, np.ndarray]]:
    return lambda folder: plaza.dataset(folder / "plaza_range", form=form)


# Seconds of a scan of a flight.
WINDOW = 0.1
TRACKS = {
    **{f"track, UWB {flight}": TrackGuard(_course(flight), ok, 0.0) for flight, ok in FLOWN.items()},
    **{f"track, Plaza, {form}": TrackGuard(_mower(form), 0.4, 0.0) for form in ("raw", "offset", "affine")},
    **{f"track, MRCLAM {n}, bearings": TrackGuard(_robot(n, BEARINGS), 0.88, 0.005) for n in (1, 2, 5)},
    **{f"track, MRCLAM {n}, bearings and ranges": TrackGuard(_robot(n, BOTH), 0.88, 0.015) for n in (1, 2, 5)},
}


@pytest.fixture(scope="module")
def book():
    header = ("set", "noise", "fixes", "`ok`", "beyond 5 sigma", "median error, m", "from the truth, m")
    names = [*(f"{name}, {noise}" for name in SETS for noise in ("stated", "learnt")), *TRACKS]
    with ledger(
        "real", header, names, "fixes by `auto`, tracks by `iekf` at constant velocity (`test_real.py`)"
    ) as made:
        yield made


@pytest.mark.parametrize("name", SETS)
def test_fixes_of_real_data_keep_their_promise(book, data_dir, name):
    guard = SETS[name]
    data = datasets.load(guard.name, folder=data_dir, **guard.options)
    now, structure = learnt(data.problem)
    for key, noise, problem, limits in (
        ("stated", "stated", data.problem, guard.stated),
        ("learnt", structure, now, guard.learnt),
    ):
        found = count(problem, data.truth)
        report(f"{name}, {noise}: {found}")
        book.add(f"{name}, {key}", noise, *found.cells)
        assert found.ok >= (limits[0] - SLACK) * found.fixes
        assert found.far <= (limits[1] + SLACK) * found.likely


def counted(problem: Problem, truth: np.ndarray) -> Counts:
    """Return the counts of the scans of a track at constant velocity; likely are those that are `ok`."""
    entries = [entry for entry in tracked(problem, polynomial(1, 1.0)) if np.isfinite(entry.updated.mean).all()]
    at = np.searchsorted(problem.times, [entry.time for entry in entries])
    d = problem.dimension
    error = np.array([entry.updated.mean[:d] for entry in entries]) - truth[at, :d]
    good = np.array([entry.code == Status.OK for entry in entries])
    cov = np.array([entry.updated.cov[:d, :d] for entry in entries])
    squared = np.einsum("ni,nij,nj->n", error[good], np.linalg.pinv(cov[good]), error[good])
    median, far = float(np.median(np.linalg.norm(error, axis=1))), int((squared > FAR**2).sum())
    return Counts(len(problem.times), int(good.sum()), int(good.sum()), far, median, np.nan)


@pytest.mark.parametrize("name", TRACKS)
def test_tracks_of_real_data_keep_their_promise(book, data_dir, name):
    guard = TRACKS[name]
    found = counted(*guard.read(data_dir))
    report(f"{name}: {found}")
    book.add(name, "stated", *found.cells[:-1], "-")
    assert found.ok >= (guard.ok - SLACK) * found.fixes
    assert found.far <= (guard.far + SLACK) * found.likely
