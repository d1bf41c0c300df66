"""P and S arrivals with one origin time: combinations of arrivals give the same fixes as the arrivals themselves."""

import numpy as np
import pytest
from scipy.optimize import least_squares

import optloc
from optloc import InvalidProblem
from optloc.problem.phases import phase_rows, phases

RATIO = 1.73
# Arrivals of each station: P alone, both, S alone.
MIXES = {
    "P at all, S at some": ("P", "PS", "P", "PS", "P", "P"),
    "all three": ("P", "PS", "S", "PS", "S", "P", "P"),
    "both": ("PS", "PS", "PS", "PS", "PS"),
    "S alone": ("S", "S", "S", "S", "S", "S"),
    "P alone": ("P", "P", "P", "P", "P", "P"),
}


def drawn(waves, seed):
    """Return stations, and the values, stations and waves of arrivals with errors of 100 m (P) and 200 m (S)."""
    generator = np.random.default_rng(seed)
    places = generator.uniform(-20e3, 20e3, (len(waves), 3)) * [1, 1, 0.05]
    focus = np.append(generator.uniform(-8e3, 8e3, 2), -9e3)
    station = np.array([i for i, word in enumerate(waves) for _ in word])
    is_s = np.array([wave == "S" for word in waves for wave in word])
    sigma = np.where(is_s, 200.0, 100.0)
    r = np.linalg.norm(places - focus, axis=1)[station]
    z = np.where(is_s, RATIO, 1.0) * r + 7e3 + sigma * generator.standard_normal(len(r))
    return places, focus, z, station, is_s, sigma


@pytest.mark.parametrize("mix", MIXES)
def test_the_fix_is_the_least_squares_fix_of_all_arrivals(mix, seed):
    for number in range(4):
        places, focus, z, station, is_s, sigma = drawn(MIXES[mix], 10 * seed + number)
        rows, joint = phases(z, a=station, is_s=is_s, ratio=RATIO, sigma=sigma)
        ground = optloc.constraints.box([-1e6, -1e6, -1e5], [1e6, 1e6, 1e3])
        fix = optloc.solve(optloc.assemble(places, *rows, covariance=joint, constraints=ground))

        def residual(x, places=places, z=z, station=station, is_s=is_s, sigma=sigma):
            r = np.linalg.norm(places - x[:3], axis=1)[station]
            return (z - x[3] - np.where(is_s, RATIO, 1.0) * r) / sigma

        scale = [1e3, 1e3, 1e3, 1e3]
        truth = least_squares(residual, [*focus, 7e3], x_scale=scale, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert sum(block.rows.count for block in rows) == len(z)
        # the best fix costs no more than the minimum near the focus, and at its own position the costs are equal
        assert fix.cost <= 2 * truth.cost * (1 + 1e-6) + 1e-6
        k = np.where(is_s, RATIO, 1.0)
        left = z - k * np.linalg.norm(places - fix.position, axis=1)[station]
        origin = (left / sigma**2).sum() / (1 / sigma**2).sum()
        assert fix.cost == pytest.approx((((left - origin) / sigma) ** 2).sum(), rel=1e-6, abs=1e-6)
        if np.linalg.norm(fix.position - truth.x[:3]) < 1.0:
            jacobian = np.linalg.inv(truth.jac.T @ truth.jac)[:3, :3]
            assert fix.sigma() == pytest.approx(np.sqrt(np.diag(jacobian)), rel=1e-3)


def test_events_have_origin_times_of_their_own():
    places, _, z, station, is_s, sigma = drawn(MIXES["all three"], 3)
    late = z + 5e4
    both = phases(
        np.concatenate([z, late]),
        a=np.tile(station, 2),
        is_s=np.tile(is_s, 2),
        ratio=RATIO,
        sigma=np.tile(sigma, 2),
        epoch=np.repeat([0, 1], len(z)),
    )
    fix = optloc.solve(optloc.assemble(places, *both[0], covariance=both[1], motions=(optloc.Motion(span="epoch"),)))
    first, second = fix.local[..., :3].reshape(2, 3) if fix.local is not None else fix.position.reshape(2, 3)
    assert first == pytest.approx(second, abs=1e-3)
    epoch = np.concatenate([block.rows.epoch for block in both[0]])
    assert not both[1][np.ix_(epoch == 0, epoch == 1)].any()


def test_without_a_station_with_both_one_s_arrival_is_unused():
    sets, unused = phase_rows(np.array([0, 1, 2, 3, 4]), np.array([0, 0, 0, 1, 1], dtype=bool), np.zeros(5), RATIO)
    assert {one.kind: len(one.a) for one in sets} == {"toa": 3, "tdoa": 1}
    assert unused.tolist() == [3]


@pytest.mark.parametrize("ratio", [1.0, 0.5, np.inf, np.nan])
def test_s_waves_are_slower(ratio):
    with pytest.raises(InvalidProblem, match=r"the ratio vp / vs is .* not above 1"):
        phase_rows(np.zeros(1, dtype=int), np.ones(1, dtype=bool), np.zeros(1), ratio)


def test_arrays_have_one_value_for_each_arrival():
    with pytest.raises(InvalidProblem, match="there are 3 arrivals, but another argument has another length"):
        phases(np.zeros(3), a=[0, 1], is_s=[False, True], ratio=RATIO, sigma=1.0)
