"""UWB flights tracked from a start without a guess: short windows of a moving tag, wild values among their rows."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pandas as pd
import pytest
from data.windows import report
from monte_carlo.tables import write

from optloc.datasets import uwb
from optloc.track import Rules, collected, polynomial, tracked

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


@pytest.mark.parametrize("flight", LIMIT)
def test_flights_are_tracked_without_a_guess(data_dir, flight):
    found = flown(data_dir / "util_uwb_tdoa", flight)
    report(
        f"UWB {flight}: {len(found.labels)} scans, started at scan {found.labels.index('started')}, 3-D rms "
        f"{found.rms:.3f} m, largest {found.error.max():.2f} m; {100 * found.left_out:.1f} % of the rows left out"
    )
    assert found.labels.count("started") == 1, "one track, and no other"
    assert found.labels.index("started") <= 10
    assert set(found.labels) <= {"starting", "started", "ok"}
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


def test_a_flight_from_the_floor_finds_itself_in_the_air(data_dir):
    """On the floor multipath puts starts metres off; the track is ended by what contradicts it, and begun anew."""
    problem, truth = uwb.course(data_dir / "util_uwb_tdoa", "F01", WINDOW, airborne=False, until=20.0)
    entries = list(tracked(problem, polynomial(1, ACCELERATION), "ekf", rules=Rules(gate=GATE)))
    position = collected(entries, 3).position
    assert [entry.label for entry in entries].count("restarted") >= 1
    later = (problem.times > 5.0) & (problem.times < 20.0)
    error = np.linalg.norm(position - truth, axis=-1)[later]
    report(f"UWB F01 from the floor: from second 5 on largest error {error.max():.2f} m")
    assert error.max() < 1.0
