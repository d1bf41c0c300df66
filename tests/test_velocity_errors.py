"""Errors of the stations' velocities, as unknowns of an epoch or the run, or as noise: in bounds, fixes and files."""

from dataclasses import replace

import numpy as np
import pytest

import optloc
from optloc import InvalidProblem, Stations, assemble, crlb, measured, simulate, solve

TRUTH = np.array([4e3, -3e3])
SPANS = pytest.mark.parametrize("span", ["epoch", "run", "noise"])


def problem_of(span="noise", sigma=2.0, *, epochs=3, rate=0.5, place=None, kind="range_rate", step=50.0, far=300.0):
    """Return ranges and rates of an emitter at rest by five stations that move, whose velocities are known to sigma."""
    rng = np.random.default_rng(0)
    position = rng.uniform(-8e3, 8e3, (1, 5, 2)) + step * np.arange(epochs)[:, None, None]
    covariance = None if sigma is None else np.tile(sigma**2 * np.eye(2), (5, 1, 1))
    where = None if place is None else np.tile(place**2 * np.eye(2), (5, 1, 1))
    velocity = np.broadcast_to(rng.normal(0.0, 80.0, (5, 2)), (epochs, 5, 2))
    stations = Stations(position, tuple("ABCDE"), velocity, None, where, span, covariance)
    first = 1 if kind == "fdoa" else 0
    a, epoch = (v.ravel() for v in np.meshgrid(np.arange(first, 5), np.arange(epochs)))
    own = {"b": 0, "arrival_sigma": rate} if kind == "fdoa" else {"sigma": rate}
    rows = [measured(kind, a=a, epoch=epoch, **own), measured("range", a=a, epoch=epoch, sigma=far)]
    problem = assemble(stations, *rows)
    return problem, np.append(TRUTH, np.zeros(problem.layout.size - 2))


@pytest.mark.parametrize("kind", ["range_rate", "fdoa"])
def test_noise_of_equal_velocities_is_noise_of_the_rates(kind):
    # Along any line of sight an isotropic error is one of the same size; a station's is common to its differences.
    noisy, x = problem_of(sigma=2.0, rate=0.5, kind=kind)
    exact, _ = problem_of(sigma=None, rate=np.hypot(2.0, 0.5), kind=kind)
    np.testing.assert_allclose(crlb(noisy, x), crlb(exact, x), rtol=1e-9)


@pytest.mark.parametrize("place", [None, 20.0])
def test_noise_and_unknowns_of_each_epoch_bound_alike(place):
    noise, unknown = (crlb(*problem_of(span, place=place)) for span in ("noise", "epoch"))
    np.testing.assert_allclose(noise, unknown, rtol=1e-8)


def test_errors_that_last_do_not_average_out():
    # Seen along the same lines, twelve epochs make the noise smaller and leave the error of a velocity as it is.
    many, x = problem_of("run", epochs=12, step=0.0)
    once, _ = problem_of(sigma=None, epochs=1, step=0.0, rate=np.hypot(2.0, 0.5 / np.sqrt(12)), far=300.0 / np.sqrt(12))
    np.testing.assert_allclose(crlb(many, x)[:2, :2], crlb(once, x[:2]), rtol=1e-8)


def test_the_layout_has_a_slot_of_velocities():
    problem, _ = problem_of("run", place=20.0)
    slots = {slot.name: slot for slot in problem.layout.shared}
    assert slots["station velocities"].unit == "m/s"
    assert slots["station velocities"].entries[:3] == ("A x", "A y", "B x")
    assert [slot.size for slot in problem.layout.shared] == [2, 10, 10]
    assert not problem_of("noise")[0].layout.local


@SPANS
def test_fixes_are_consistent(span, seed):
    problem, x = problem_of(span, place=20.0)
    trials, rng = 40, np.random.default_rng(seed)
    truth = np.broadcast_to(x, (trials, len(x))).copy()
    shared, n = problem.layout, problem.layout.n_shared
    if span == "run":
        truth[:, 2:12], truth[:, 12:22] = 20.0 * rng.normal(size=(trials, 10)), 2.0 * rng.normal(size=(trials, 10))
    if span == "epoch":
        sizes = np.concatenate([np.full(slot.size, 20.0 if slot.unit == "m" else 2.0) for slot in shared.local])
        truth[:, n:] = np.tile(sizes, 3) * rng.normal(size=(trials, 60))
    fix = solve(simulate(problem, truth, seed), "gtrs+lsr", start=truth)
    error = fix.position - TRUTH
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fix.covariance()), error)
    assert nees.mean() == pytest.approx(2.0, abs=4.0 * np.sqrt(4.0 / trials))
    # A fix that takes the velocities for exact is too sure of itself, by far.
    bold = replace(problem, stations=replace(problem.stations, covariance=None, velocity_covariance=None))
    z = simulate(problem, truth, seed).z
    other = solve(bold.with_rows(z=z), "gtrs+lsr", start=np.broadcast_to(TRUTH, (trials, 2)))
    error = other.position - TRUTH
    assert np.einsum("ni,nij,nj->n", error, np.linalg.inv(other.covariance()), error).mean() > 4.0


def test_nothing_is_proven_of_rates_with_unsure_velocities():
    problem, x = problem_of("noise", epochs=1)
    fix = solve(simulate(problem, x, 1))
    assert fix.status is not optloc.Status.OK
    assert "velocities change range_rate rows" in fix.certificate.reason


def test_rows_without_rates_do_not_feel_them():
    problem, x = problem_of("noise", epochs=1, kind="range")
    stations = replace(problem.stations, velocity_covariance=None)
    np.testing.assert_allclose(crlb(problem, x), crlb(replace(problem, stations=stations), x), rtol=1e-12)
    drawn = simulate(problem, x, 1)
    assert solve(drawn).status is solve(replace(drawn, stations=stations)).status


@pytest.mark.parametrize(
    ("covariance", "words"),
    [(np.eye(2), "the errors of station velocities"), (-np.tile(np.eye(2), (5, 1, 1)), "velocity error of station")],
)
def test_wrong_covariances_are_told(covariance, words):
    problem, _ = problem_of()
    rows = measured("range_rate", a=np.arange(5), sigma=1.0)
    with pytest.raises(InvalidProblem, match=words):
        assemble(replace(problem.stations, velocity_covariance=covariance), rows)


FILE = """
format = 2

[stations]
{keys}
rows = [
  {{ name = "A", x = 0, y = 0, vx = 50, vy = 0{column} }},
  {{ name = "B", x = 3000, y = 0, vx = 0, vy = 50{column} }},
  {{ name = "C", x = 0, y = 3000, vx = -20, vy = 30{column} }},
]

[[measurements]]
kind = "range_rate"
sigma = "0.1 m/s"
rows = [{{ a = "A", z = 1 }}, {{ a = "B", z = 2 }}, {{ a = "C", z = 3 }}]
"""


@pytest.mark.parametrize(
    ("keys", "column", "sigma"),
    [
        ('velocity_sigma = "0.5 m/s"', "", 0.5),
        ('velocity_sigma = 1.8\nspeed_unit = "km/h"', "", 0.5),
        ('span = "run"', ", velocity_sigma = 0.5", 0.5),
        ('sigma = "5 m"', "", None),
    ],
)
def test_a_file_states_them(tmp_path, keys, column, sigma):
    path = tmp_path / "rates.toml"
    path.write_text(FILE.format(keys=keys, column=column))
    stations = optloc.load(path).stations
    if sigma is None:
        assert stations.velocity_covariance is None
        return
    np.testing.assert_allclose(stations.velocity_covariance, np.tile(sigma**2 * np.eye(2), (3, 1, 1)))
    assert stations.covariance is None
    assert stations.span == ("run" if "run" in keys else "epoch")


@pytest.mark.parametrize(
    ("keys", "column", "words"),
    [
        ('velocity_sigma = "5 m"', "", "velocity_sigma"),
        ("velocity_sigma = -1.0", "", "remove velocity_sigma"),
        ("", ", velocity_sigma = 0", "not positive"),
    ],
)
def test_a_file_that_states_them_wrongly_is_told(tmp_path, keys, column, words):
    path = tmp_path / "rates.toml"
    path.write_text(FILE.format(keys=keys, column=column))
    with pytest.raises(InvalidProblem, match=words):
        optloc.load(path)
