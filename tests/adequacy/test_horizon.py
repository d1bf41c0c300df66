"""What the Earth hides is told with its cost, and a constraint is blamed only where there is one."""

import numpy as np
import pytest

import optloc
from optloc.base.frames import ECEF
from optloc.base.types import Status
from optloc.solvers.certify.branch_and_bound import BARRED, LOST

UP = np.array([[1.0, 0.2, 0.1], [0.9, -0.3, 0.3], [0.8, 0.5, -0.3], [0.7, -0.4, -0.5], [0.6, 0.1, 0.8]])
SATELLITES = 26.6e6 * UP / np.linalg.norm(UP, axis=1)[:, None]
# Half a kilometre above the ellipsoid, on the side that no satellite sees.
HIDDEN = np.array(ECEF.from_geodetic(np.radians(1.0), np.radians(178.0), 500.0))


def heard(constraints=()):
    rows = optloc.measured("range", a=np.arange(len(SATELLITES)), sigma=10.0)
    template = optloc.assemble(SATELLITES, rows, frame=ECEF, constraints=list(constraints))
    return optloc.simulate(template, truth=HIDDEN, seed=1)


@pytest.mark.parametrize("bounds", [(), optloc.constraints.height(0.0, 20e3)], ids=["free", "height"])
def test_a_hidden_minimum_is_told_with_cost_and_place(bounds):
    fix = optloc.solve(heard(bounds), "gtrs+lsr")
    reason = str(fix.reason)
    # without a bound the mirror image in the plane of the satellites is left, out in space, and fits nothing
    assert fix.status == (Status.INFEASIBLE if bounds else Status.MISFIT)
    assert "the only minimum found, of cost 0." in reason
    assert "behind the Earth" in reason
    assert "1.00" in reason  # its latitude
    assert "178.00" in reason
    assert "height" not in reason


def test_a_misfit_before_the_horizon_tells_what_lies_behind_it():
    fix = optloc.solve(heard())
    assert fix.status == Status.MISFIT
    assert "behind the Earth" in str(fix.reason)
    assert fix.certificate.reason == BARRED.format("the Earth hides it from a satellite")


@pytest.mark.parametrize("method", ["auto", "gtrs+lsr"])
def test_the_earth_hides_from_a_batch_what_it_hides_from_one(method):
    """Machine code of many fixes knows nothing of the Earth: what it finds behind it is no answer."""
    one = heard()
    many = one.with_rows(z=np.tile(one.z, (20, 1)))
    alone = optloc.solve(one, method)
    for fix in (optloc.solve(many, method), optloc.prepare(one, method)(many.z)):
        assert (fix.code == alone.code).all()
        assert all("behind the Earth" in reason for reason in fix.reason)


def test_without_earth_and_constraint_nothing_is_said_to_forbid():
    assert "constraint" not in LOST
    assert "Earth" not in LOST
    place = np.array([[0.0, 0.0], [9e3, 1e3], [8e3, 9e3], [1e3, 8e3], [5e3, 12e3]])
    template = optloc.assemble(place, optloc.measured("range", a=np.arange(5), sigma=5.0), constraints=[])
    for seed in range(5):
        fix = optloc.solve(optloc.simulate(template, truth=[4e3, 3e3], seed=seed))
        assert "forbids" not in fix.certificate.reason


def orbit(longitude, inclination, phase, times):
    """Return places (k, 3) of a satellite on an inclined geosynchronous circle; degrees, hours."""
    along, tilt = 2.0 * np.pi / 23.934 * times + np.radians(phase), np.radians(inclination)
    x, y, z = np.cos(along), np.sin(along) * np.cos(tilt), np.sin(along) * np.sin(tilt)
    turned = np.radians(longitude) - along
    return 42164.2e3 * np.stack(
        [np.cos(turned) * x - np.sin(turned) * y, np.sin(turned) * x + np.cos(turned) * y, z], -1
    )


def test_where_all_that_starts_lead_to_is_hidden_a_search_finds_what_is_in_sight():
    """Four time differences of two satellites and a height: the cheaper of two places lies behind the Earth."""
    hours, truth = 0.5 * np.arange(4), np.array(ECEF.from_geodetic(*np.radians([50.45, 30.52]), 180.0))
    place = np.stack([orbit(10.0, 0.08, 40.0, hours), orbit(13.0, 1.9, 250.0, hours)], axis=1)
    template = optloc.assemble(
        place,
        optloc.measured("tdoa", sigma=30.0, a=[0] * 4, b=[1] * 4, epoch=np.arange(4)),
        times=3600.0 * hours,
        motions=[optloc.Motion()],
        constraints=optloc.constraints.height(exactly=180.0),
        frame=ECEF,
    )
    for seed in range(4):
        one = optloc.simulate(template, truth=truth, seed=seed)
        fix, best = optloc.solve(one), optloc.solve(one, start=truth)
        assert fix.answered
        assert fix.cost <= best.cost + 1e-6
