"""Tables of satellites: places at transmission are turned with the Earth during the flight, whatever the clock says."""

import numpy as np
import pytest
from typer.testing import CliRunner

from optloc import InvalidProblem, solve
from optloc.base.frames import ECEF
from optloc.base.units import SPEED_OF_LIGHT
from optloc.cli import app
from optloc.files import load
from optloc.files.convert import convert, interpret_table
from optloc.files.roles import Roles
from optloc.files.satellite_tables import pseudoranges, write_satellites
from optloc.files.table import of_rows
from optloc.files.table_import import ColumnHints
from optloc.problem import by_epoch

RUN = CliRunner()
RATE = 7.2921151467e-5


def turned(place, seconds):
    """Return a place along the axes that the Earth has so many seconds later."""
    angle = RATE * seconds
    return np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]) @ place


def receiver(lat, lon, height=80.0):
    return ECEF.from_geodetic(np.radians(lat), np.radians(lon), height)


def sky(at, count, rng, far=2.66e7):
    """Return places of satellites above the horizon of a receiver, on a sphere, along the axes at reception."""
    axes, out = ECEF.enu_axes(at), []
    while len(out) < count:
        way = axes.T @ rng.normal(size=3)
        way = way / np.linalg.norm(way)
        if way @ axes[2] < 0.2:
            continue
        b = at @ way
        out.append(at + (-b + np.sqrt(b**2 + far**2 - at @ at)) * way)
    return out


def table(folder, at, *, clocks=(3e-3,), count=8, seed=1, unit="m", sent=True, far=2.66e7, name="gnss.csv"):
    """Write pseudoranges without noise; satellites stand where they were when they sent, then or at reception."""
    size = {"m": 1.0, "km": 1e3}[unit]
    rng, lines = np.random.default_rng(seed), [f"epoch,satellite,x_{unit},y_{unit},z_{unit},pseudorange_{unit}"]
    for k, clock in enumerate(clocks):
        for i, place in enumerate(sky(at, count, rng, far)):
            flight = np.linalg.norm(place - at) / SPEED_OF_LIGHT
            x, y, z = (turned(place, -flight) if sent else place) / size
            rho = float((flight + clock) * SPEED_OF_LIGHT / size)
            lines.append(f"{k},G{i:02d},{float(x)!r},{float(y)!r},{float(z)!r},{rho!r}")
    path = folder / name
    path.write_text("\n".join(lines) + "\n")
    return path


def miss(problem, at):
    return float(np.linalg.norm(solve(by_epoch(problem)).position - at, axis=-1).max())


@pytest.mark.parametrize(
    ("lat", "lon", "clocks", "unit", "far"),
    [
        (52.5, 13.4, (0.0,), "m", 2.66e7),
        (-33.9, 151.2, (1e-3, -1e-3, 0.1), "m", 2.66e7),  # a clock that is 0.1 s off
        (0.1, -78.5, (-0.5, 0.9), "km", 2.96e7),
        (78.2, 15.6, (2e-4,), "km", 4.2e7),
        (64.1, -21.9, (1e-3,), "m", 7.2e6),  # a low orbit
    ],
)
def test_places_at_transmission_are_turned(lat, lon, clocks, unit, far, tmp_path):
    at = receiver(lat, lon)
    sent = table(tmp_path, at, clocks=clocks, unit=unit, far=far)
    there = table(tmp_path, at, clocks=clocks, unit=unit, far=far, sent=False, name="there.csv")
    found, right = (
        interpret_table(path, ColumnHints(sigma="1 m", turned=path == there)).read().problem for path in (sent, there)
    )
    # The turned places are those at reception to less than a millimetre.
    assert np.abs(found.stations.position - right.stations.position).max() < 1e-4
    assert miss(found, at) < 1e-3
    if far > 2e7 and lat < 60.0:
        unturned = interpret_table(sent, ColumnHints(sigma="1 m", turned=True)).read().problem
        assert miss(unturned, at) > 10.0


def test_the_command_says_what_it_turned(tmp_path):
    at = receiver(52.5, 13.4)
    path, out = table(tmp_path, at), tmp_path / "gnss.toml"
    told = RUN.invoke(app, ["convert", str(path), "--sigma", "1 m", "--out", str(out)])
    assert told.exit_code == 0, told.output
    assert "Satellite positions are rotated with the Earth during the signal flight; --turned uses them unchanged." in (
        " ".join(told.stdout.split())
    )
    assert "in ECEF axes at transmission" in told.stdout
    assert "# Satellite positions are at transmission, in the Earth axes at reception." in out.read_text()
    assert miss(load(out), at) < 1e-3
    there = table(tmp_path, at, sent=False, name="there.csv")
    told = RUN.invoke(app, ["convert", str(there), "--sigma", "1 m", "--turned"])
    assert "in ECEF axes at reception" in told.stdout
    assert "are turned with" not in told.stdout


def test_epochs_in_any_order_and_with_few_satellites(tmp_path):
    at = receiver(35.3, 139.5)
    path = table(tmp_path, at, clocks=(1e-3, 2e-3, 3e-3, 4e-3))
    head, *lines = path.read_text().splitlines()
    few = [line for line in lines if not line.startswith("2,") or line.split(",")[1] in ("G00", "G01", "G02")]
    shuffled = [few[i] for i in np.random.default_rng(5).permutation(len(few))]
    path.write_text("\n".join([head, *shuffled]) + "\n")
    loaded = interpret_table(path, ColumnHints(sigma="1 m")).read()
    fix = solve(by_epoch(loaded.problem))
    good = [k for k, label in enumerate(loaded.epochs) if label != "2"]
    assert np.linalg.norm(fix.position - at, axis=-1)[good].max() < 1e-3


def test_three_satellites_and_a_height(tmp_path):
    at = receiver(48.2, 16.4, 190.0)
    path = table(tmp_path, at, clocks=(5e-3,), count=3, seed=4)
    out = tmp_path / "three.toml"
    convert(path, out, sigma="1 m")
    out.write_text(out.read_text() + '[[constraints]]\nkind = "height"\nexactly = "190 m"\n')
    assert miss(load(out), at) < 2e-2


def test_too_few_satellites_are_not_turned(tmp_path):
    at = receiver(48.2, 16.4)
    path = table(tmp_path, at, count=2)
    with pytest.raises(InvalidProblem, match=r"gnss.csv: no epoch has 3 satellites.*cannot be rotated.*use --turned"):
        interpret_table(path, ColumnHints(sigma="1 m"))
    assert interpret_table(path, ColumnHints(sigma="1 m", turned=True)).read().problem.count == 2


def test_turned_is_refused_where_there_are_no_satellites(tmp_path):
    path = tmp_path / "ranges.csv"
    path.write_text("lat,lon,range_m\n59.9,10.7,100\n59.91,10.7,900\n59.9,10.71,700\n")
    with pytest.raises(InvalidProblem, match="--turned: the table has no satellites"):
        interpret_table(path, ColumnHints(sigma="1 m", turned=True))


def sent(**change):
    """Return the roles of a table of two satellites."""
    rows = [
        {"epoch": 0, "satellite": name, "x_km": 26e3, "y_km": y, "z_km": 0.0, "pseudorange_km": 2e4}
        for name, y in (("G1", 0.0), ("G2", 1.0))
    ]
    return Roles.of(of_rows([row | change for row in rows], "t.csv", {}), {})


def test_pseudoranges_are_arrivals_at_satellites_that_move(tmp_path):
    found = pseudoranges(tmp_path / "t.csv", sent(), ColumnHints(sigma="2 m", turned=True))
    (section,) = found.sections
    assert (section.kind, section.unit, section.sigma) == ("toa", "km", "2 m")
    assert section.columns["z"].tolist() == [2e4, 2e4]
    assert found.places.columns["y"].tolist() == [0.0, 1.0]
    assert (found.places.frame, found.places.unit) == ("ecef", "km")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"satellite": "G1"}, "'G1' occurs again at epoch '0', first in row 1"),
        ({"x_km": 26.0}, "26 km from the centre"),
    ],
)
def test_satellites_twice_or_within_the_earth_are_refused(change, words, tmp_path):
    with pytest.raises(InvalidProblem, match=words):
        pseudoranges(tmp_path / "t.csv", sent(**change), ColumnHints(sigma="2 m", turned=True))


def test_orbits_are_wanted_at_times(tmp_path):
    with pytest.raises(InvalidProblem, match="times of the satellite positions are unknown"):
        write_satellites(tmp_path / "a.tle", tmp_path / "a.csv", {}, None, None)
