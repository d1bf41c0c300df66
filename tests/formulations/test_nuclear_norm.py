"""The nuclear norm of a network, a baseline: its own minimum, loose alone, exact without noise where passes arrive."""

import numpy as np
import pytest
from scipy.optimize import minimize
from sites.calibration.scenes import hall

from formulations.metric_upgrade import upgrade
from formulations.nuclear_norm import affine_network, nuclear_offsets


def centred(z, o):
    """Return squared arrivals (M, N) without offsets, centred over stations and pulses by their means."""
    table = (z**2 - 2.0 * z * o[:, None]).T
    return table - table.mean(axis=0) - table.mean(axis=1, keepdims=True) + table.mean()


def norm(z, o):
    return np.linalg.svd(centred(z, o))[1].sum()


def drawn(seed, m, n, d=3):
    """Return stations, times and arrivals of a hall of width one without noise."""
    truth, z = hall(seed, m, n, 0.0, box=np.array([1.0, 1.0, 0.3])[3 - d :])
    shift = np.median(z, axis=1)
    return truth.stations[0], truth.emission[0] - shift, z - shift[:, None]


@pytest.mark.parametrize(("m", "n", "d"), [(6, 12, 3), (6, 7, 2)])
def test_one_pass_is_the_least_nuclear_norm(m, n, d):
    _, truth, z = drawn(m, m, n, d)
    found = nuclear_offsets(z, d, passes=1)
    assert found.value == pytest.approx(norm(z, found.offset), rel=1e-9)
    most = z.min(axis=1)
    assert (found.offset <= most + 1e-6).all()

    def smooth(o):
        s2 = np.linalg.eigvalsh(centred(z, o) @ centred(z, o).T)
        return np.sqrt(np.maximum(s2, 0.0) + 1e-12).sum()

    # an iteration from the truth that knows nothing of cones, polished from our answer as well
    bounds = [(None, b) for b in most]
    others = [minimize(smooth, begin, method="L-BFGS-B", bounds=bounds).x for begin in (truth, found.offset)]
    least = min(norm(z, o) for o in others)
    assert least == pytest.approx(found.value, rel=1e-3)
    assert found.value <= least * (1.0 + 1e-6)
    assert found.value * (1.0 - 1e-4) <= found.bound <= found.value * (1.0 + 1e-6)


def test_the_nuclear_norm_alone_is_not_tight():
    for seed in range(3):
        _, truth, z = drawn(seed, 10, 12)
        found = nuclear_offsets(z, 3, passes=1)
        assert found.value < 0.95 * norm(z, truth)
        assert np.abs(found.offset - truth).max() > 0.05


@pytest.mark.parametrize(("m", "n", "d", "arrive"), [(10, 12, 3, 3), (8, 12, 2, 3)])
def test_truncated_passes_are_exact_without_noise(m, n, d, arrive):
    for seed in range(arrive):
        stations, truth, z = drawn(seed, m, n, d)
        found = nuclear_offsets(z, d, passes=40)
        assert found.offset == pytest.approx(truth, abs=1e-5)
        assert found.beyond < 1e-6
        fit = affine_network(z, found.offset, d)
        i, k = np.tril_indices(m, -1)
        apart = np.linalg.norm(stations[i] - stations[k], axis=1)
        ends = [np.abs(np.linalg.norm(a[i] - a[k], axis=1) - apart).max() for a in upgrade(fit)[0]]
        assert min(ends) < 1e-3


def test_true_times_make_the_affine_network_exact():
    stations, truth, z = drawn(3, 10, 12)
    fit = affine_network(z, truth, 3)
    assert fit.cost[0] < 1e-25
    i, k = np.tril_indices(10, -1)
    apart = np.linalg.norm(stations[i] - stations[k], axis=1)
    # some candidates are kept from being flat, which this network does not need
    ends = [np.abs(np.linalg.norm(a[i] - a[k], axis=1) - apart).max() for a in upgrade(fit)[0]]
    assert min(ends) < 1e-8


def test_adding_a_time_to_a_pulse_moves_its_time_alone():
    _, _, z = drawn(2, 8, 9)
    shift = np.linspace(-0.3, 0.3, 9)
    one, two = (nuclear_offsets(table, 3, passes=1) for table in (z, z + shift[:, None]))
    assert two.value == pytest.approx(one.value, rel=1e-6)
    assert two.offset - shift == pytest.approx(one.offset, abs=1e-4)
