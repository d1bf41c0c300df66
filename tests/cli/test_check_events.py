"""`optloc check` of a table: health by columns is that of events which are read and fixed one by one."""

import numpy as np
import pytest
from typer.testing import CliRunner

from optloc import solve
from optloc.cli import app
from optloc.cli.check import _check_health
from optloc.files.convert import interpret_table
from optloc.files.table_import import ColumnHints
from optloc.station_health import health

RUN = CliRunner()
SITES = np.random.default_rng(4).uniform([-3e4, -3e4, 0.0], [3e4, 3e4, 3e3], (9, 3))
EVENTS = 12
C = 0.299792458  # metres in a nanosecond


def tables(folder, counts, *, gap=(), wrong=(), bearing=False):
    """Write a table of events with counts of rows in turn, and return what is said of it and its rows by event."""
    rng, events = np.random.default_rng(7), []
    for k in range(EVENTS):
        target, own = rng.uniform([-2e4, -2e4, 4e3], [2e4, 2e4, 9e3]), rng.permutation(9)[: counts[k % len(counts)]]
        away = target - SITES[own]
        value = (
            np.linalg.norm(away, axis=1)
            + rng.normal(0.0, 9.0, len(own))
            + 6e3 * (np.arange(len(own)) == 1) * (k in wrong)
        )
        north = np.degrees(np.arctan2(away[:, 0], away[:, 1]) + rng.normal(0.0, 0.003, len(own))) % 360.0
        cells = [f"{v:.3f},{b:.4f}" if bearing else f"{v / C:.3f}" for v, b in zip(value, north, strict=True)]
        lines = [
            f"{k},R{a},{'' if (k, i) in gap else cell}" for i, (a, cell) in enumerate(zip(own, cells, strict=True))
        ]
        events.append(lines)
    places = [f"R{i},{x},{y},{z}" for i, (x, y, z) in enumerate(SITES.tolist())]
    (folder / "sites.csv").write_text("\n".join(["name,x_m,y_m,z_m", *places]) + "\n")
    sigma = "range=9 m,azimuth=0.2 deg" if bearing else "30 ns"
    told = ColumnHints(stations=folder / "sites.csv", sigma=sigma, azimuth="north-clockwise" if bearing else None)
    return told, "message,station," + ("range_m,azimuth_deg" if bearing else "toa_ns"), events


def read(folder, told, head, lines, name="all.csv"):
    (folder / name).write_text("\n".join([head, *lines]) + "\n")
    return interpret_table(folder / name, told).read()


CASES = {
    "same stations": {"counts": [9]},
    "other stations": {"counts": [6, 7]},
    "few rows": {"counts": [7, 3, 7, 2]},
    "empty cells": {"counts": [7, 8], "gap": [(3, 2), (9, 1), (9, 4)]},
    "two kinds": {"counts": [5, 6], "bearing": True},
    "wrong rows": {"counts": [8, 9], "wrong": [2, 9]},
}


@pytest.mark.parametrize(
    ("case", "method", "by"),
    [
        ("same stations", "gtrs+lsr", "station"),
        ("other stations", "cauchy", "station"),
        ("few rows", "gtrs+lsr", "station"),
        ("empty cells", "gtrs+lsr", "pair"),
        ("two kinds", "gtrs+lsr", "kind"),
        ("wrong rows", "robust", "pair"),
    ],
)
def test_a_table_has_the_health_of_its_events_one_by_one(tmp_path, case, method, by):
    told, head, events = tables(tmp_path, **CASES[case])
    loaded = read(tmp_path, told, head, [line for lines in events for line in lines])
    found = _check_health(loaded, method, by, True)
    for k in range(1, EVENTS, 4):  # epochs of a table are in the order of their times
        label = loaded.epochs[k]
        fix = solve(read(tmp_path, told, head, events[int(label)], f"{label}.csv").problem, method)
        assert fix.answered == np.isfinite(found.vectors[k]).all()
        if fix.answered:
            np.testing.assert_allclose(found.vectors[k], fix.x, atol=1e-2)
    own = health(loaded.problem, by, method=method)  # rows of all events as one batch
    assert found.health.names == own.names
    np.testing.assert_array_equal(found.health.count, own.count)
    for name in ("bias", "bias_error", "noise", "noise_error", "outliers", "least_noticed", "suspect"):
        np.testing.assert_allclose(getattr(found.health, name), getattr(own, name), rtol=1e-3, atol=1e-3, err_msg=name)


def test_suspects_of_events_with_other_stations_are_counted_by_their_own_rows(tmp_path):
    """Every second event has one wrong row: it is suspected, and no other."""
    told, head, events = tables(tmp_path, [8, 9], wrong=range(0, EVENTS, 2))
    loaded = read(tmp_path, told, head, [line for lines in events for line in lines])
    found = _check_health(loaded, "robust", "pair", True).health
    wrong = [lines[1].split(",")[1] for k, lines in enumerate(events) if k % 2 == 0]
    heard = [line.split(",")[1] for lines in events for line in lines]
    share = {name: wrong.count(name) / heard.count(name) for name in dict.fromkeys(heard)}
    assert dict(zip(found.names, found.suspect.tolist(), strict=True)) == pytest.approx(share)


def test_errors_of_stations_in_an_epoch_are_noise_for_health_and_advice(tmp_path):
    _, _, events = tables(tmp_path, [7, 8])
    places = (tmp_path / "sites.csv").read_text().splitlines()
    (tmp_path / "s.csv").write_text("\n".join(["name,x,y,z,sigma", *(f"{line},5" for line in places[1:])]) + "\n")
    rows = [line.split(",") for lines in events[:6] for line in lines]
    (tmp_path / "r.csv").write_text("epoch,a,z\n" + "".join(f"{k},{a},{v}\n" for k, a, v in rows))
    text = 'format = 2\n[stations]\nfile = "s.csv"\n[[measurements]]\nkind = "toa"\nfile = "r.csv"\nunit = "ns"\n'
    (tmp_path / "p.toml").write_text(text + 'sigma = "30 ns"\n')
    found = RUN.invoke(app, ["check", str(tmp_path / "p.toml")])
    assert found.exit_code == 0, found.output
    assert "Health by station" in found.output


@pytest.mark.parametrize(
    ("text", "told"),
    [("message,station,toa_ns\n", "the table has no rows"), ("", "the file is empty"), ("1", "no")],
)
def test_tables_without_rows_are_refused(tmp_path, text, told):
    tables(tmp_path, [6])
    (tmp_path / "t.csv").write_text(text)
    found = RUN.invoke(app, ["check", str(tmp_path / "t.csv"), "--stations", str(tmp_path / "sites.csv")])
    assert found.exit_code == 2
    assert told in found.output
