"""UWB flights tracked from a start without a guess: short windows of a moving tag, wild values among their rows."""

from dataclasses import dataclass
from functools import cache
from time import process_time

import numpy as np
import pandas as pd
import pytest
from data.windows import report
from monte_carlo.tables import write
from often import few

from optloc.lab.datasets import uwb
from optloc.tracking import Rules, collected, polynomial, tracked

pytestmark = pytest.mark.data

WINDOW, ACCELERATION, GATE = 0.1, 1.0, 4.0
# Largest 3-D root mean square error of a flight, metres; what blocks the line of sight is in the set's README.
LIMIT = {"F01": 0.35, "F02": 0.35, "F03": 0.35, "F04": 0.35, "F05": 0.35, "F06": 0.35}


@dataclass(frozen=True)
class Flown:
    """A flight as it was tracked: labels of the scans, errors (k,) of those with a state, share of rows left out."""

    labels: list[str]
    error: np.ndarray
    left_out: float

    @property
    def rms(self):
        return float(np.sqrt(np.mean(self.error**2)))


@cache
def flown(folder, flight):
    problem, truth = uwb.course(folder, flight, WINDOW)
    entries = list(tracked(problem, polynomial(1, ACCELERATION), "ekf", rules=Rules(gate=GATE)))
    error = np.linalg.norm(collected(entries, 3).position - truth, axis=-1)
    left_out = sum(entry.rejected for entry in entries) / problem.count
    return Flown([entry.label for entry in entries], error[np.isfinite(error)], left_out)


@pytest.mark.parametrize("flight", few(LIMIT, 1))
def test_flights_are_tracked_without_a_guess(data_dir, flight):
    found = flown(data_dir / "util_uwb_tdoa", flight)
    report(
        f"UWB {flight}: {len(found.labels)} scans, started at scan {found.labels.index('started')}, 3-D rms "
        f"{found.rms:.3f} m, largest {found.error.max():.2f} m; {100 * found.left_out:.1f} % of the rows left out"
    )
    assert found.labels.count("started") == 1, "one track, and no other"
    assert found.labels.index("started") <= 10
    # metal blocks a path of F04 for seconds: innovations are then more than twice as large as stated, and it says so
    assert set(found.labels) <= {"starting", "started", "ok"} | ({"misfit"} if flight == "F04" else set())
    assert found.labels.count("ok") > 0.8 * len(found.labels)
    assert found.rms <= LIMIT[flight]
    assert found.error.max() < 1.0, "never lost"


@pytest.mark.full
def test_the_table_of_the_documentation(data_dir):
    folder, rows = data_dir / "util_uwb_tdoa", []
    flights = pd.read_csv(folder / "flights.csv").set_index("flight")
    for flight in LIMIT:
        found = flown(folder, flight)
        high, far = np.quantile(found.error, 0.95), found.error.max()
        waited = WINDOW * found.labels.index("started")
        cells = [f"{waited:.1f} s", f"{found.rms:.2f}", f"{high:.2f}", f"{far:.2f}", f"{100 * found.left_out:.1f} %"]
        rows.append([flight, f"{flights.loc[flight, 'mode']} {flights.loc[flight, 'condition']}", *cells])
    header = ["flight", "mode, line of sight", "start after", "3-D rms, m", "95 %, m", "largest, m", "rows left out"]
    write(
        "flights", header, rows, f"windows of {WINDOW} s, extended Kalman filter, {ACCELERATION:g} m/s², gate {GATE:g}"
    )


@pytest.mark.parametrize("flight", few(LIMIT, 1))
def test_flights_from_the_floor_find_themselves_in_the_air(data_dir, flight):
    """On the floor multipath puts most rows metres off: no state there is right, but one is soon there in the air."""
    problem, truth = uwb.course(data_dir / "util_uwb_tdoa", flight, WINDOW, airborne=False)
    entries, scans, began = [], None, process_time()
    for entry in tracked(problem, polynomial(1, ACCELERATION), "ekf", rules=Rules(gate=GATE)):
        entries.append(entry)
        if scans is None and np.isfinite(entry.updated.mean).all():
            scans, seconds = len(entries), process_time() - began
    error = np.linalg.norm(collected(entries, 3).position - truth, axis=-1)
    air = np.flatnonzero(truth[:, 2] > 0.5)
    report(
        f"UWB {flight} from the floor: a state after {scans} scans and {seconds:.2f} s of work; in the air "
        f"{np.isnan(error[air]).sum()} scans without one, largest error {np.nanmax(error[air]):.2f} m"
    )
    assert scans <= 60  # each try takes bounded work: 2 s in all on a quiet core; without a bound 575 scans took 70 s
    # never lost where the rows are good; up to two seconds are spent on a start that does not contradict itself
    assert np.nanmax(error[air]) < 1.0
    assert not np.isnan(error[air[20:]]).any()
