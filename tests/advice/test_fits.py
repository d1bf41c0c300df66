"""Fits of changes are least-squares fits of their parameters and of the positions."""

import numpy as np
from advice.cases import NAMES, PLACES, at, range_case
from scipy.optimize import least_squares

import optloc
from optloc.advice.change import Change, ErrorColumn
from optloc.advice.fits import fit, is_out_of_reach
from optloc.advice.wording import no_words


def own_cost(problem, count, error):
    """Return the least cost of an own fit of positions and of one more parameter."""
    z = problem.z.reshape(count, 7)

    def residual(y):
        h = np.linalg.norm(y[1:].reshape(count, 1, 2) - PLACES, axis=-1)
        return ((z - error(h, y[0])) / 3.0).ravel()

    starts = [np.concatenate([[0.0], np.tile([x, y], count)]) for x in (2e3, 6e3) for y in (4e3, 8e3)]
    return min(2.0 * least_squares(residual, start, x_scale=[10.0, *[1e3] * (2 * count)]).cost for start in starts)


def test_an_offset_of_several_epochs_is_fitted_with_the_positions():
    case, problem = range_case(at(2, 60.0), epochs=3)
    column = ErrorColumn("adds", np.broadcast_to(at(2, 1.0), (3, 7)))
    found = fit(case, [Change("offset", no_words, (NAMES[2],), columns=(column,))])
    assert abs(found.theta[0, 0] - 60.0) < 5.0 * found.sigma[0, 0] < 60.0
    assert np.isclose(found.cost.sum(), own_cost(problem, 3, lambda h, t: h + at(2, t)), rtol=1e-3)


def test_a_scale_keeps_the_noise_of_the_recorded_values():
    case, problem = range_case(0.0, epochs=2)
    larger = problem.with_rows(z=1.05 * problem.z)
    case = type(case)(case.base.with_rows(z=1.05 * case.base.z), case.times, case.number, case.x, case.dof)
    column = ErrorColumn("scales", np.ones((2, 7)))
    found = fit(case, [Change("speed", no_words, columns=(column,), starts=((0.0,),))])
    assert np.isclose(found.cost.sum(), own_cost(larger, 2, lambda h, t: (1.0 + t) * h), rtol=1e-3)


def test_values_that_shrink_fit_no_position_because_their_noise_shrinks():
    case, _ = range_case()
    found = fit(case, [Change("unit", no_words, factor=1e-3)])
    assert found.cost.sum() > 1e6


def test_a_change_without_information_has_an_infinite_cost():
    case, _ = range_case()
    found = fit(case, [Change("offset", no_words, columns=(ErrorColumn("adds", np.zeros((1, 7))),), starts=((0.0,),))])
    assert not np.isfinite(found.cost).any()


def test_no_signal_comes_from_the_other_side_of_the_earth_or_its_centre():
    frame = optloc.Frame("ecef")
    geodetic = np.array([[47.0, 11.0, 0.0], [-47.0, -169.0, 0.0], [47.0, 11.0, -1e6], [40.0, 60.0, 4e7]])
    angles = np.radians(geodetic[:, :2])
    targets = frame.from_geodetic(angles[:, 0], angles[:, 1], geodetic[:, 2])
    network = targets[0] + 1e4 * np.eye(3)
    around = 7e6 * np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    for stations, hidden in ((network, [False, True, True, False]), (around, [False] * 4)):
        rows = optloc.measured("range", a=np.arange(len(stations)), sigma=1.0)
        problem = optloc.assemble(stations, rows, frame=frame).flat()
        assert is_out_of_reach(problem.take(np.zeros(4, dtype=int)), targets[:, None]).ravel().tolist() == hidden
