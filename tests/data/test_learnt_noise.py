"""Noise that is learnt from one half of real data says of the other half how right fixes are."""

from dataclasses import dataclass

import numpy as np
import pytest
from data.windows import report, statuses
from often import few

from optloc import Motion, Problem, Status, assemble, measured, solve
from optloc.lab.datasets import mrclam, starloc, uwb
from optloc.lab.datasets.reading import Window
from optloc.problem import by_epoch
from optloc.station_health import noise_levels, with_noise_levels

pytestmark = pytest.mark.data

# Sets of robots, and every how many epochs are taken.
ROBOTS = {1: 1, 2: 3, 5: 3}
GROUPS = 800
FLIGHTS = ("F01", "F02", "F03", "F04", "F05", "F06")
DAILY = "F01"
EACH = [pytest.param(flight, marks=[] if flight == DAILY else pytest.mark.full) for flight in FLIGHTS]
# Standard deviations beyond which a fix that is ok is wrong, and the probability from which on it counts.
FAR, LIKELY = 5.0, 0.01


@dataclass(frozen=True)
class Halves:
    """Epochs to learn from, most with known places, others to fix, and their truth (n, d)."""

    learn: Problem
    other: Problem
    truth: np.ndarray


def counted(name: str, halves: Halves, by: str, method: str) -> tuple[int, int]:
    """Return how many fixes that are ok and likely there are, and how many of these are far off by their own sigma."""
    levels = noise_levels(halves.learn, by, common=True)
    fix = solve(by_epoch(with_noise_levels(halves.other, levels)).flat(), method)
    good = (fix.code == Status.OK) & (fix.p_value > LIKELY)
    error, cov = (fix.position - halves.truth)[good], fix.covariance("position")[good]
    off = np.sqrt(np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error))
    far = int((off > FAR).sum())
    report(f"{name}, {method}: {statuses(fix)}; {good.sum()} ok and likely, {far} beyond {FAR:g} sigma")
    return int(good.sum()), far


def flight(folder, name: str, *, known: bool = True) -> Halves:
    """Return every other window of a flight, to learn from at known places or by fixes."""
    data = uwb.load(folder, name, shared=False)

    def problem(windows: tuple[Window, ...], motion: Motion) -> Problem:
        epoch = np.repeat(np.arange(len(windows)), [len(w.a) for w in windows])
        a, b, z = (np.concatenate([getattr(w, column) for w in windows]) for column in "abz")
        return assemble(
            data.stations, measured("tdoa", z, a=a, b=b, sigma=uwb.INDEPENDENT, epoch=epoch), motions=(motion,)
        )

    learn, other = (np.array([w.truth for w in data.windows[k::2]]) for k in (0, 1))
    motion = Motion(span="epoch", known=learn[:, None] if known else None)
    return Halves(problem(data.windows[0::2], motion), problem(data.windows[1::2], Motion(span="epoch")), other)


def robots(folder, number: int) -> Halves:
    """Return every other of the epochs of a set, by bearings and ranges."""
    data, kinds = mrclam.load(folder, number).every(ROBOTS[number]), ("azimuth", "range")
    learn, other = (data.every(2, first) for first in (0, 1))
    return Halves(learn.problem(kinds, known=True), other.problem(kinds), other.truth)


def camera(folder, run: str) -> Halves:
    """Return groups of bearings from every other frame of a run, whose noise grows as the camera turns."""
    whole = starloc.read_run(folder, run, "cal")
    learn, other = (whole.half(k).groups(GROUPS, seed=6 + k) for k in (0, 1))
    return Halves(learn.problem(turning=True, known=True), other.problem(turning=True), other.truth)


def within_one_in_a_hundred(counts: list[tuple[int, int]]) -> None:
    good, far = (sum(column) for column in zip(*counts, strict=True))
    report(f"together {far} of {good}")
    assert far <= 0.01 * good


@pytest.mark.slow
@pytest.mark.parametrize("known", few([False, True], 1), ids=["from fixes", "at known places"])
@pytest.mark.parametrize("name", EACH)
def test_flights_by_what_each_anchor_is_off_in_a_window(data_dir, name, known):
    # What lasts for a window is the error of an anchor's arrival, not of a pair: its two pairs have it with two signs.
    good, far = counted(name, flight(data_dir / "util_uwb_tdoa", name, known=known), "station", "auto")
    assert good > 0
    assert not far


@pytest.mark.full
def test_flights_without_what_is_left_out(data_dir):
    folder = data_dir / "util_uwb_tdoa"
    within_one_in_a_hundred([counted(name, flight(folder, name), "station", "robust") for name in FLIGHTS])


@pytest.mark.parametrize("method", few(["auto", "robust"], 1))
@pytest.mark.slow
def test_robots_by_what_an_epoch_has_in_common(data_dir, method):
    folder = data_dir / "mrclam_aoa2d"
    within_one_in_a_hundred([counted(f"MRCLAM {n}", robots(folder, n), "kind", method) for n in ROBOTS])


@pytest.mark.full
def test_markers_by_what_a_group_has_in_common(data_dir):
    # Some markers of R1 stand centimetres off the map that is the truth here.
    folder = data_dir / "starloc_aoa"
    within_one_in_a_hundred([counted(f"STAR-loc {run}", camera(folder, run), "kind", "robust") for run in ("R1", "R2")])
