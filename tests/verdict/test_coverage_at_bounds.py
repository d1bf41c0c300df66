"""Coverage of fixes at bounds and near them, for truths inside the bounds and on them."""

import numpy as np
import pytest

from optloc import Frame, Status, assemble, constraints, measured, solve, station_array

ENU = Frame.enu(lat_deg=48.1, lon_deg=11.5)
# Share of truths in the 95 % regions, inside the bounds, that chance leaves once in ten thousand times or more.
LIKELY = (0.92, 0.98)


def rows_of(place, truth, sigma, kind, rng):
    """Return measurements of ranges or of their differences."""
    z = np.linalg.norm(place - truth, axis=1) + sigma * rng.standard_normal(len(place))
    if kind == "range":
        return measured("range", z, a=np.arange(len(z)), sigma=sigma)
    return measured("tdoa", z[1:] - z[0], a=np.arange(1, len(z)), b=0, arrival_sigma=sigma)


def in_a_box(rng, kind):
    """Return a problem in a box of 0.5 to 16 standard deviations, its truth, and whether it is on an edge."""
    place, sigma, middle = rng.uniform(-50.0, 50.0, (rng.integers(4, 8), 2)), 2.0, rng.uniform(-25.0, 25.0, 2)
    line = (place - middle) / np.linalg.norm(place - middle, axis=1)[:, None]
    line = line if kind == "range" else line - line.mean(0)
    spread = sigma * np.sqrt(np.linalg.eigvalsh(np.linalg.inv(line.T @ line)).mean())
    side = spread * rng.uniform(0.5, 16.0, 2)
    lower, upper = middle - 0.5 * side, middle + 0.5 * side
    truth, edge = rng.uniform(lower, upper), rng.random() < 0.25
    if edge:
        i = rng.integers(2)
        truth[i] = (lower, upper)[rng.integers(2)][i]
    rows = rows_of(place, truth, sigma, kind, rng)
    return station_array(place), rows, {"constraints": constraints.box(lower, upper)}, truth, edge


def above_ground(rng, kind):
    """Return a problem in space with the ground as a bound, its truth, and whether it is on the ground."""
    count, sigma, edge = rng.integers(5, 9), 10 ** rng.uniform(0.0, 1.3), rng.random() < 0.3
    place = np.column_stack([rng.uniform(-3e3, 3e3, (count, 2)), rng.uniform(0.0, rng.choice([100.0, 1e3]), count)])
    lat, lon, _ = ENU.to_geodetic(np.append(rng.uniform(-3e3, 3e3, 2), 0.0))
    truth = ENU.from_geodetic(lat, lon, 0.0 if edge else rng.uniform(0.0, rng.choice([100.0, 1500.0])))
    rows = rows_of(place, truth, sigma, kind, rng)
    return station_array(place), rows, {"constraints": constraints.height(0.0), "frame": ENU}, truth, edge


@pytest.mark.full
@pytest.mark.parametrize("scene", [in_a_box, above_ground])
def test_regions_at_bounds_hold_95_percent(scene):
    rng, inside, edge, good, held = np.random.default_rng(201), [], [], 0, 0
    for k in range(500):
        stations, rows, demands, truth, on_edge = scene(rng, ("range", "tdoa")[k % 2])
        fix = solve(assemble(stations, rows, **demands))
        if len(fix.active[()]):
            free = {key: value for key, value in demands.items() if key != "constraints"}
            sound = solve(assemble(stations, rows, **free)).status == Status.OK
            held, good = held + sound, good + (sound and fix.status == Status.OK)
        if fix.status == Status.OK:
            (edge if on_edge else inside).append(bool(fix.covers(truth)))
    assert good >= 0.8 * held
    assert LIKELY[0] <= np.mean(inside) <= LIKELY[1]
    assert np.mean(edge) >= 0.88
