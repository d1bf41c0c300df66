"""Linear forms over a box: reaches, products, and what a range leaves beside its slope, by brute force."""

from types import SimpleNamespace

import numpy as np
import pytest

from optloc.proof.nodes.node import (
    NodeRow,
    hypot_excess,
    lay_out,
    length_across,
    product,
    range_form,
    range_hessian,
    reach,
    scaled,
)

pytestmark = pytest.mark.usefixtures("plainly")


def inside(rng, half, count=400):
    return rng.uniform(-1.0, 1.0, (count, 3)) * half


def test_reaches_and_products_of_forms_hold_in_every_sample():
    rng = np.random.default_rng(0)
    for _ in range(20):
        u, v, h = rng.normal(size=(3, 3))
        h = np.abs(h)
        s = inside(rng, h)
        assert np.abs(s @ u).max() <= reach(u, h) == pytest.approx(np.abs(u) @ h)
        low, high = product(u, v, h)
        both = (s @ u) * (s @ v)
        assert low <= both.min()
        assert both.max() <= high


def test_quotients_are_enclosed_by_the_right_ends():
    assert scaled(-2.0, 3.0, 0.5, 4.0) == (-4.0, 6.0)
    assert scaled(1.0, 3.0, 0.5, 4.0) == (0.25, 6.0)


def test_the_excess_of_a_hypotenuse_keeps_its_digits():
    assert hypot_excess(3.0, 4.0) == pytest.approx(2.0)
    assert hypot_excess(1e9, 1.0) == pytest.approx(0.5e-9, rel=1e-12)
    assert hypot_excess(-3.0, 4.0) == pytest.approx(8.0)


def test_a_range_over_a_box_is_between_its_linear_form_and_the_remainder():
    rng = np.random.default_rng(1)
    for _ in range(20):
        line, sense, half = 5.0 * rng.normal(size=3), rng.normal(size=(3, 3)), np.abs(rng.normal(size=3))
        r, u, least, rest, far = range_form(line, sense, half)
        s = inside(rng, half)
        ranges = np.linalg.norm(line + s @ sense.T, axis=1)
        left = ranges - r - s @ np.array(u)
        assert -1e-12 <= left.min()
        assert left.max() <= rest + 1e-12
        assert least <= r + (s @ np.array(u)).min()
        assert ranges.max() <= far
        if least > 0.0:
            hessian = np.array(range_hessian(sense, half, r, u, least, rest)[0])
            n = line / r
            expected = sense.T @ (np.eye(3) - np.outer(n, n)) @ sense / r
            np.testing.assert_allclose(hessian, expected[np.triu_indices(3)], atol=1e-12)


def test_what_is_across_a_unit_vector_is_no_longer_than_bounded():
    rng = np.random.default_rng(2)
    sense, half, n = rng.normal(size=(3, 3)), np.array([1.0, 0.5, 2.0]), np.array([0.6, 0.0, 0.8])
    moved = inside(rng, half) @ sense.T
    left = np.linalg.norm(moved - np.outer(moved @ n, n), axis=1)
    assert left.max() <= length_across(sense, n @ sense, half)


def test_a_row_reads_the_stations_of_its_own_epoch():
    position = np.arange(12.0).reshape(2, 3, 2)
    turned = np.array([[0.0, 1.0], [-1.0, 0.0]])
    stations = SimpleNamespace(position=position, velocity=10.0 * position[1:], axes=np.tile(turned, (1, 3, 1, 1)))
    row = NodeRow(SimpleNamespace(stations=stations, dimension=2), 1, -1, 1, np.zeros(1))
    assert row.place(2).tolist() == [[10.0, 11.0]]
    assert row.velocity(0).tolist() == [[60.0, 70.0]]
    assert row.axes(0).tolist() == [[0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0]]


def test_parts_are_laid_out_where_they_begin():
    out = lay_out({0: np.array([[1.0, 2.0]]), 3: np.array([[7.0], [8.0]])})
    assert out.tolist() == [[1.0, 2.0, 0.0, 7.0], [1.0, 2.0, 0.0, 8.0]]
