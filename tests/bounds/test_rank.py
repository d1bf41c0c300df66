"""Observability by name: what is open, what is known from where, and that scales of units do not matter."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from optloc import Motion, Stations, assemble, crlb, measured, simulate, solve, with_bias
from optloc.base.frames import Frame
from optloc.bounds.rank import observability
from optloc.lab.papers import registration as scenes
from optloc.linear.constraints import height
from optloc.linear.normal import linearise
from optloc.problem import Prior

NAMES = tuple("ABCDEF")
PLACE = np.random.default_rng(3).uniform(-5e3, 5e3, (6, 3))


def steady(kind="tdoa", epochs=4, motion=None, names=NAMES, velocity=None, **noise):
    """Return rows of six stations for a target, seen again and again."""
    k = np.arange(epochs)
    track = PLACE + (0.0 if velocity is None else k[:, None, None] * velocity)
    station = np.arange(6) if kind != "tdoa" else np.arange(1, 6)
    rows = measured(
        kind,
        a=np.tile(station, epochs),
        b=0 if kind == "tdoa" else None,
        epoch=np.repeat(k, len(station)),
        **(noise or {"sigma": 3.0}),
    )
    place = np.broadcast_to(track, (epochs, 6, 3)) if velocity is not None else PLACE[None]
    return assemble(Stations(place, names), rows, motions=[motion or Motion()], times=k.astype(float))


def at(problem, place=(9e3, 3e3, 2e3)):
    x = np.zeros(problem.layout.size)
    shared, local = problem.layout.split(x)
    (shared if problem.motions[0].span == "run" else local)[..., :3] = place
    return x


def test_everything_is_open_or_known_as_the_bound_says():
    problem = with_bias(steady("range", motion=Motion(1)), "delay", per="kind", sigma=40.0)
    seen = observability(problem, at(problem))
    np.testing.assert_allclose(seen.posterior, np.sqrt(np.diagonal(crlb(problem, at(problem)))), rtol=1e-9)
    alone = with_bias(steady("range", motion=Motion(1)), "delay", per="kind")
    np.testing.assert_allclose(seen.data, np.sqrt(np.diagonal(crlb(alone, at(alone)))), rtol=1e-9)
    assert (seen.rank, seen.open) == (7, ())
    np.testing.assert_array_equal(seen.prior, [*[np.inf] * 6, 40.0])
    np.testing.assert_allclose(1.0 / seen.posterior[6] ** 2, 1.0 / seen.data[6] ** 2 + 1.0 / 40.0**2, rtol=1e-9)
    np.testing.assert_allclose(seen.from_data[6], 1.0 - (seen.posterior[6] / 40.0) ** 2)
    assert (seen.from_data[:6] == 1.0).all()


def test_a_common_clock_error_of_differences_is_open():
    """Moving stations see every difference of clock errors, but no error that all share."""
    velocity = np.random.default_rng(5).uniform(-300.0, 300.0, (6, 3))
    problem = with_bias(steady(epochs=40, velocity=velocity), "clock", sigma=200.0)
    seen = observability(problem, at(problem))
    assert seen.open == ("the data do not determine a common change of every clock",)
    assert seen.rank == 8
    assert np.isinf(seen.data[3:]).all()
    assert np.isfinite(seen.data[:3]).all()
    # What remains of the prior is the mean of six clocks.
    np.testing.assert_allclose(seen.posterior[3:], 200.0 / np.sqrt(6.0), rtol=1e-3)
    part = with_bias(steady(epochs=40, velocity=velocity), "clock", members=list("BCDEF"))
    assert observability(part, at(part)).sentences == ()


def test_a_steady_geometry_leaves_combinations_open():
    problem = with_bias(steady(), "clock", members=list("BCDEF"), sigma=100.0)
    seen = observability(problem, at(problem))
    assert seen.rank == 5
    everything = "position x, position y, position z, clock B, clock C, clock D, clock E and clock F"
    assert seen.open == (f"the data do not determine 3 combinations of {everything}",)
    assert np.isinf(seen.data).all()


def test_a_clock_error_against_a_free_emission_time():
    problem = with_bias(steady("toa", epochs=5, motion=Motion(0, "epoch")), "clock", sigma=50.0)
    x = at(problem)
    problem.layout.split(x)[1][:, :3] = np.random.default_rng(2).uniform(-9e3, 9e3, (5, 3))
    seen = observability(problem, x)
    assert seen.open == ("the data do not determine a common change of every clock",)
    np.testing.assert_allclose(seen.posterior, np.sqrt(np.diagonal(crlb(problem, x))), rtol=1e-6)


def test_epochs_that_cannot_fix_their_own_target_still_count():
    """Two receivers of a pulse from an unknown place and time say nothing of their clocks; six at a known one do."""
    problem = with_bias(steady("toa", epochs=3, motion=Motion(0, "epoch")), "clock", sigma=50.0)
    weight = np.ones(18)
    weight[:4] = 0.0
    x = at(problem)
    problem.layout.split(x)[1][:, :3] = np.random.default_rng(2).uniform(-9e3, 9e3, (3, 3))
    less = observability(problem.with_rows(weight=weight), x)
    weight[:6] = 0.0
    none = observability(problem.with_rows(weight=weight), x)
    np.testing.assert_allclose(less.posterior, none.posterior, rtol=1e-9)


@given(st.floats(1e-6, 1e6), st.integers(0, 5))
def test_scales_of_units_do_not_matter(scale, reference):
    """A bias in units a million times smaller or greater is as open or as known as before."""
    members = [name for i, name in enumerate(NAMES) if i != reference]
    problem = with_bias(steady(epochs=3), "clock", members=members)
    (bias,) = problem.biases
    other = replace(problem, biases=(replace(bias, coefficient=bias.coefficient / scale),))
    one, two = observability(problem, at(problem)), observability(other, at(other))
    assert one.rank == two.rank
    np.testing.assert_array_equal(np.isinf(one.data), np.isinf(two.data))


def test_one_bias_that_mixes_with_one_coordinate():
    """Ranges along one line: the place along it and a common delay are one."""
    line = np.stack([np.array([x, 0.0]) for x in (0.0, 500.0, 900.0)])
    problem = with_bias(assemble(line, measured("range", a=[0, 1, 2], sigma=1.0)), "delay", per="kind")
    seen = observability(problem, np.array([5e3, 0.0, 0.0]))
    assert set(seen.open) == {
        "the data do not determine position y",
        "the data do not determine a change of position x by +1 m and delay range by -1 m",
    }
    scaled = with_bias(assemble(line, measured("range", a=[0], sigma=1.0)), "scale", per="kind", form="scale")
    sentences = observability(scaled, np.array([5e3, 0.0, 0.0])).open
    assert "the data do not determine a change of position x by +1 m and scale range by -0.0002" in sentences


def test_a_bias_that_cannot_be_told_from_a_coordinate():
    problem = scenes.problem(scenes.PRINTED, 40, prior=200.0)
    seen = observability(problem, scenes.truth(scenes.PRINTED, problem))
    (sentence,) = seen.tied
    assert sentence.startswith("hard to separate: position z, delay 4-1 and delay 5-1 (correlated up to 0.999")
    longer = scenes.problem(scenes.SPATIAL, 600)
    assert observability(longer, scenes.truth(scenes.SPATIAL, longer)).open == ()


def test_equalities_count_as_geometry():
    frame = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0)
    flat = PLACE * [1.0, 1.0, 0.0]
    rows = measured("range", a=np.arange(6), sigma=3.0)
    free = assemble(flat, rows, frame=frame)
    held = assemble(
        flat, rows, frame=frame, constraints=[height(exactly=frame.to_geodetic(np.array([9e3, 3e3, 0.0]))[2])]
    )
    x = np.array([9e3, 3e3, 0.0])
    assert observability(free, x).open == ("the data do not determine position z",)
    assert observability(held, x).open == ()
    assert observability(held, x).rank == 2


def test_correlated_priors():
    covariance = np.array([[9.0, 6.0, 0.0], [6.0, 16.0, 0.0], [0.0, 0.0, 1.0]])
    problem = assemble(PLACE, measured("range", a=[0], sigma=1.0), priors=[Prior("position", np.zeros(3), covariance)])
    seen = observability(problem, np.array([9e3, 3e3, 2e3]))
    np.testing.assert_allclose(seen.prior, [3.0, 4.0, 1.0])
    assert seen.rank == 1
    assert ((seen.from_data > 0.0) & (seen.from_data < 1.0)).all()


@pytest.mark.parametrize("span", ["epoch", "run", "noise"])
def test_station_errors_of_every_span(span):
    k, a = np.repeat(np.arange(30), 4), np.tile(np.arange(1, 5), 30)
    track = scenes.SPATIAL.track(30)
    stations = Stations(track, scenes.SPATIAL.names, covariance=np.stack([np.eye(3)] * 5), span=span)
    problem = with_bias(assemble(stations, measured("tdoa", a=a, b=0, epoch=k, arrival_sigma=3.0)), "delay", per="pair")
    x = at(problem, scenes.SPATIAL.target)
    seen = observability(problem, x)
    np.testing.assert_allclose(seen.posterior, np.sqrt(np.diagonal(crlb(problem, x))), rtol=1e-6)
    if span == "run":
        assert (seen.prior[7:] == 1.0).all()
        assert (seen.from_data[7:] < 0.1).all()


def test_moving_along_what_is_open_changes_no_residual():
    """A clock error of 12 m that all stations share goes unnoticed at any fix."""
    problem = with_bias(steady(), "clock", sigma=1e4)
    truth = at(problem)
    drawn = simulate(problem, truth, 1)
    fix = solve(drawn, "lsr", start=truth)
    assert np.isfinite(fix.x).all()
    moved = fix.x.copy()
    moved[3:] += 12.0
    one, two = (linearise(drawn, x).residual for x in (fix.x, moved))
    np.testing.assert_allclose(one, two, atol=1e-8)
