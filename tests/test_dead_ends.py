"""What once ended without an answer: sparse scans, no redundancy, known targets, stations at rest, open coordinates."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import optloc
from optloc import InvalidProblem, assemble, measured, solve
from optloc.cli import app
from optloc.cli.track import differences
from optloc.problem.build import station_array
from optloc.problem.epochs import by_epoch, states_by_epoch
from optloc.show.answer_texts import with_sigma
from optloc.show.columns import fix_columns
from optloc.station_health.stations import health

FREE = (optloc.Motion(0, span="epoch"),)
RING = 100.0 * np.array([[np.cos(t), np.sin(t)] for t in np.linspace(0.0, 5.0, 6)])


def run(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


# Scans with a single arrival.


def arrivals(heard, *, more=()):
    """Return a run of arrivals; `heard` says which stations hear each epoch."""
    epoch = np.concatenate([np.full(len(who), k) for k, who in enumerate(heard)])
    a = np.concatenate(heard).astype(int)
    z = np.linalg.norm(RING[a] - [10.0, 20.0], axis=-1) + 1000.0 * epoch
    return assemble(RING, measured("toa", z, a=a, sigma=1.0, epoch=epoch), *more, motions=FREE)


@pytest.mark.parametrize("heard", [[[0, 1, 2, 3], [4], [1, 2, 3]], [[5], [0, 1, 2]], [[0, 1, 2], [2]], [[1], [2]]])
def test_a_scan_of_a_single_arrival_has_no_differences(heard):
    made = differences(arrivals(heard))
    assert made.epochs == len(heard)
    assert made.count == sum(len(who) - 1 for who in heard)
    assert np.bincount(made.epoch, minlength=made.epochs).tolist() == [len(who) - 1 for who in heard]
    assert len(made.starts) == len(made.rows)


def test_a_single_arrival_beside_another_kind_keeps_that_kind():
    bearing = measured("azimuth", [0.3], a=[2], sigma=0.01, epoch=[1])
    made = differences(arrivals([[0, 1, 2], [3], [0, 1]], more=(bearing,)))
    assert {rows.kind: rows.count for rows in made.rows} == {"tdoa": 3, "azimuth": 1}


def table(folder, heard, epochs=8):
    """Write arrivals of a beacon and its stations; `heard(k)` says which of them hear message k."""
    lines = ["message,station,toa_ns"]
    for k in range(epochs):
        for i in heard(k):
            far = np.linalg.norm(RING[i] - [10.0 + k, 20.0])
            lines.append(f"{k},R{i},{10**9 * k + far / 0.299792458:.0f}")
    (folder / "a.csv").write_text("\n".join(lines) + "\n")
    names = "\n".join(f"R{i},{x},{y}" for i, (x, y) in enumerate(RING))
    (folder / "s.csv").write_text(f"name,x_m,y_m\n{names}\n")
    return ["track", folder / "a.csv", "--stations", folder / "s.csv", "--sigma", "3 ns"]


@pytest.mark.slow
def test_a_track_goes_on_over_a_single_arrival(tmp_path):
    done = run(*table(tmp_path, lambda k: [4] if k == 5 else range(6)), "--json")
    assert done.exit_code in (0, 1), done.output
    scans = json.loads(done.stdout[done.stdout.index("{") :])["scans"]
    assert scans[5]["status"] == "too few rows"
    assert [scan["status"] for scan in scans[6:]] == ["ok"] * 2


def test_a_track_of_single_arrivals_alone_is_refused(tmp_path):
    done = run(*table(tmp_path, lambda k: [k % 6]))
    assert done.exit_code == 2
    assert "has one arrival" in " ".join(done.output.split())


# Health without redundancy.


@pytest.mark.parametrize(("kind", "stations"), [("range", 2), ("toa", 3), ("azimuth", 2), ("range_sum", 2)])
def test_health_without_redundancy_is_one_sentence(kind, stations):
    rng, epochs = np.random.default_rng(0), 4
    place = rng.uniform(-50.0, 50.0, (epochs, 2))
    a = np.tile(np.arange(stations), epochs)
    away = np.repeat(place, stations, axis=0) - RING[a]
    z = np.arctan2(away[:, 1], away[:, 0]) if kind == "azimuth" else np.linalg.norm(away, axis=-1)
    more = {"b": np.full(len(a), 5)} if kind == "range_sum" else {}
    z = z + np.linalg.norm(np.repeat(place, stations, axis=0) - RING[5], axis=-1) if more else z
    rows = measured(kind, z, a=a, sigma=0.01, epoch=np.repeat(np.arange(epochs), stations), **more)
    with pytest.raises(InvalidProblem, match=r"no (fix has redundancy|epoch has a fix)"):
        health(assemble(RING, rows, motions=FREE))


def test_check_says_that_nothing_checks_the_measurements(tmp_path):
    (tmp_path / "u.csv").write_text("t_ms,P_cm,Q_cm\n0,385,517\n100,387,512\n200,391,507\n")
    (tmp_path / "s.csv").write_text("anchor,x_m,y_m\nP,0,0\nQ,6,0\n")
    done = run("check", tmp_path / "u.csv", "--stations", tmp_path / "s.csv", "--sigma", "10 cm", "--as", "range")
    said = " ".join(done.output.split())
    assert done.exit_code == 0, done.output
    assert "Station health could not be computed: no fix has redundancy" in said


# Known targets beside an unknown one.


def with_known(kinds=("toa",), unknown=1, seed=0):
    """Return a problem of three targets, all but some of which are known, with a clock to calibrate."""
    rng = np.random.default_rng(seed)
    places = np.array([[30.0, -20.0], [5.0, 40.0], [-35.0, 10.0]])
    motions = tuple(
        optloc.Motion() if i == unknown else optloc.Motion(known=place[None, None]) for i, place in enumerate(places)
    )
    a, target = np.tile(np.arange(6), 3), np.repeat(np.arange(3), 6)
    away = np.linalg.norm(places[target] - RING[a], axis=-1)
    rows = [
        measured(kind, away + 300.0 * target * (kind == "toa") + rng.standard_normal(18), a=a, sigma=1.0, target=target)
        for kind in kinds
    ]
    return assemble(RING, *rows, motions=motions), places


@pytest.mark.parametrize("unknown", [0, 1, 2])
@pytest.mark.parametrize("kinds", [("toa",), ("range",)])
def test_the_only_unknown_target_is_the_position(kinds, unknown):
    problem, places = with_known(kinds, unknown)
    fix = solve(problem)
    np.testing.assert_allclose(fix.position, places[unknown], atol=5.0)
    np.testing.assert_array_equal(fix.position, fix.take(f"position[{unknown}]"))
    assert fix.sigma().shape == (2,)
    assert fix.ellipse()[0].shape == (2,)


def test_two_unknown_targets_have_no_single_position():
    problem, places = with_known(("range",))
    fix = solve(replace(problem, motions=(optloc.Motion(), optloc.Motion(), problem.motions[2])))
    with pytest.raises(InvalidProblem, match="there is no unknown 'position'"):
        fix.position  # noqa: B018  (it raises)
    np.testing.assert_allclose(fix.take("position[0]"), places[0], atol=5.0)


@pytest.mark.slow
@pytest.mark.parametrize("unknown", [0, 2])
def test_a_picture_has_the_lines_of_the_unknown_target(unknown):
    pytest.importorskip("matplotlib")
    from optloc.show.pictures.fixes import plot_fixes
    from optloc.show.pictures.position_lines import lines_of_position

    problem, _ = with_known(("toa",), unknown)
    fix = solve(problem)
    figure = plot_fixes(problem, fix)
    labels = {text.get_text() for legend in figure.legends for text in legend.get_texts()}
    assert {"known target", "hyperbola of two arrivals"} <= labels
    x = np.linspace(-60.0, 60.0, 61)
    grid = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    found = lines_of_position(problem, fix, x, x, grid)
    # of six arrivals one is the reference of the others; those of known targets have no lines
    assert len({one.name for one in found}) == 5


# Rates of a moving target at stations without velocities.


@pytest.mark.parametrize(
    ("kind", "dimension", "seed"),
    [("range_rate", 2, 0), ("range_rate", 3, 1), ("fdoa", 2, 2), ("fdoa", 3, 3), ("range_rate", 2, 4)],
)
def test_stations_without_velocities_are_at_rest(kind, dimension, seed):
    rng = np.random.default_rng(seed)
    stations = rng.uniform(-900.0, 900.0, (8, dimension))
    away, velocity = 50.0 - stations, np.array([10.0, -5.0, 2.0])[:dimension]
    rate = (away @ velocity) / np.linalg.norm(away, axis=-1)
    z, ends = (rate, {}) if kind == "range_rate" else (rate - rate[0], {"b": np.zeros(8, dtype=int)})
    kept = slice(0 if kind == "range_rate" else 1, None)
    rows = measured(kind, z[kept], a=np.arange(8)[kept], sigma=0.01, **{k: v[kept] for k, v in ends.items()})
    ranges = measured("range", np.linalg.norm(away, axis=-1), a=np.arange(8), sigma=1.0)
    found = [
        solve(assemble(station_array(stations, velocity=v), rows, ranges, motions=(optloc.Motion(1),)))
        for v in (None, np.zeros_like(stations))
    ]
    np.testing.assert_array_equal(found[0].x, found[1].x)
    assert found[0].code == found[1].code
    np.testing.assert_allclose(found[0].velocity, velocity, atol=0.5)


def test_rates_between_points_that_stay_are_still_refused():
    rows = measured("range_rate", np.zeros(6), a=np.arange(6), sigma=0.1)
    with pytest.raises(InvalidProblem, match="needs stations that move"):
        assemble(RING, rows)


# Coordinates that the data leave open.


def floor(at=(1.0, 1.0, 0.0), kind="range", size=1.0):
    """Return a target in the plane of all its stations, of which one measures an azimuth as well."""
    stations = size * np.array(
        [[2.9, 0.5, 0], [4.8, 0.5, 0], [5.8, 0.5, 0], [2.9, 2.7, 0], [4.8, 2.6, 0], [5.8, 2.7, 0]]
    )
    away = size * np.array(at) - stations
    ranges = measured(kind, np.linalg.norm(away, axis=-1), a=np.arange(6), sigma=0.003 * size)
    return assemble(stations, ranges, measured("azimuth", [np.arctan2(away[0, 1], away[0, 0])], a=0, sigma=0.01))


@pytest.mark.parametrize(("kind", "size"), [("range", 1.0), ("toa", 1.0), ("toa", 3e4), ("range", 50.0)])
def test_a_height_that_symmetry_leaves_open_is_not_determined(kind, size):
    fix = solve(floor(kind=kind, size=size), "gtrs+lsr")
    axis, number = "z", 2
    assert fix.undetermined().tolist() == [i == number for i in range(3)]
    line = next(line for line in str(fix).splitlines() if line.startswith(f"{axis} "))
    assert line.split(None, 1)[1] == "not determined"
    assert "not determined" in fix._repr_html_()
    found = fix.to_dict()
    assert found["undetermined"] == axis
    assert found[f"sigma_{axis}"] is None
    others = [other for other in "xyz" if other != axis]
    assert all(found[f"sigma_{other}"] is not None for other in others)
    assert found[f"cov_{others[0]}{others[1]}"] is not None
    frame = fix.to_dataframe()
    assert np.isnan(frame[f"sigma_{axis}"][0])
    assert frame["undetermined"][0] == axis
    assert json.loads(json.dumps(found))["undetermined"] == axis


def test_a_fix_that_is_determined_has_no_such_column():
    fix = solve(floor(at=(1.0, 1.0, 1.5)))
    assert not fix.undetermined().any()
    assert "undetermined" not in fix_columns(fix)
    assert "not determined" not in str(fix)


def test_a_batch_names_the_open_coordinates_of_each():
    problem = floor()
    z = np.stack([floor().z, floor(at=(1.0, 1.0, 1.5)).z])
    fix = solve(problem.with_rows(z=z), "gtrs+lsr")
    assert fix_columns(fix)["undetermined"].tolist() == ["z", ""]


def test_a_number_is_never_minus_nothing():
    assert with_sigma(-1e-20, 0.5, "m") == "0.00 ± 0.50 m"
    assert with_sigma(-0.3, 0.5, "m") == "-0.30 ± 0.50 m"


# Epochs as a batch: independent rows take a short way, and states need no rows.


@pytest.mark.parametrize("seed", [0, 1])
def test_states_by_epoch_are_those_of_the_batch(seed):
    rng = np.random.default_rng(seed)
    sigma, ends = rng.uniform(0.1, 1.0, 12), {"a": np.tile(np.arange(6), 2), "epoch": np.repeat([0, 1], 6)}
    rows = measured("range", rng.uniform(1.0, 9.0, 12), sigma=sigma, **ends)
    problem = assemble(RING, rows, motions=FREE)
    batch, states = by_epoch(problem), states_by_epoch(problem)
    assert [slot.name for slot in states.layout.shared] == [slot.name for slot in batch.layout.shared]
    (block,) = batch.noise.blocks
    np.testing.assert_allclose(np.sqrt(block.covariance[..., 0, 0]), sigma.reshape(2, 6))
