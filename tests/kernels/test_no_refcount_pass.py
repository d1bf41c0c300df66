"""Kernels that only borrow arrays count no references to them, all others do, and no array is lost or freed early."""

import sys
from typing import NamedTuple

import numpy as np
import pytest

from optloc.kernels.compilation import callee_compiler
from optloc.kernels.jit import compiled, enabled
from optloc.proof.atlas import atlas_of
from optloc.proof.box import least_residual
from optloc.proof.curvature import spread_of, sum_up
from optloc.proof.nodes.dispatch import bound_pieces, curve_pieces
from optloc.proof.pieces import is_left
from optloc.proof.search_space import cost_of, empty_box

pytestmark = pytest.mark.skipif(not enabled(), reason="machine code")


class Pair(NamedTuple):
    first: np.ndarray
    second: np.ndarray


@compiled
def total(pair):
    """Borrows: fields, slices and loops."""
    whole, row = 0.0, pair.second[1]
    for value in pair.first:
        whole += value
    for k in range(row.shape[0]):
        whole += row[k]
    pair.first[:] = 1.0
    return whole


@compiled
def made(pair):
    """Makes an array, though none is returned."""
    copy = pair.first.copy()
    copy[0] = 2.0
    return copy[0] + pair.first[1]


@compiled
def summed(pair):
    """Makes an array in an expression."""
    return (pair.first + pair.second[0])[0]


@compiled
def picked(pair, index):
    return pair.first[index][0]


@compiled
def given_back(pair):
    return pair.second[1]


@compiled
def swapped(pair):
    return Pair(pair.second[0], pair.first)


@compiled
def assigned(pair):
    """Copies by a temporary array where the two overlap."""
    pair.second[0] = pair.first
    return 0.0


@compiled
def listed(pair):
    kept = [pair.first]
    return kept[0][0]


@compiled
def through_all(pair, index):
    """Calls all of them: machine code of what is called is what borrows."""
    value = total(pair) + made(pair) + summed(pair) + picked(pair, index) + assigned(pair) + listed(pair)
    back, other = given_back(pair), swapped(pair)
    return value + back[0] + other.first[0] + other.second[0], back, other


def borrows(kernel, arguments):
    """Return whether machine code of a kernel, made anew as other kernels call it, counts no references."""
    from numba import njit, typeof

    made = njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, pipeline_class=callee_compiler())(kernel.function)
    made.compile(tuple(typeof(one) for one in arguments))
    (found,) = made.overloads.values()
    return not found.target_context.enable_nrt


@pytest.mark.slow
def test_only_what_makes_keeps_and_returns_no_array_borrows():
    pair, index = Pair(np.arange(3.0), np.ones((2, 3))), np.array([1, 0])
    assert borrows(total, (pair,))
    assert not borrows(picked, (pair, index))
    for kernel in (made, summed, given_back, swapped, assigned, listed):
        assert not borrows(kernel, (pair,)), kernel


@pytest.mark.slow
def test_references_are_as_many_afterwards_and_what_is_returned_lives_on():
    first, second, index = np.arange(3.0), np.ones((2, 3)), np.array([1, 0])
    through_all(Pair(first, second), index)
    before = [sys.getrefcount(one) for one in (first, second, index)]
    for _ in range(200):
        value, back, other = through_all(Pair(first, second), index)
    del other
    assert np.isfinite(value)
    back[:] = 5.0
    assert (second[1] == 5.0).all()
    del back
    assert [sys.getrefcount(one) for one in (first, second, index)] == before


def test_the_kernels_of_every_box_borrow():
    """Proofs took twice as long where each counted its dozen arrays."""
    K, box = np.eye(3), empty_box(3, 3)
    cost = cost_of(np.zeros(3, dtype=np.int64), np.zeros((3, 12)), K, np.zeros(3))
    atlas = atlas_of(np.zeros(3), 1.0, 3, 1)
    calls = {
        bound_pieces: (atlas, cost.kinds, cost.data, box.half, box.nodes),
        curve_pieces: (atlas, cost.kinds, cost.data, box.half, box.nodes, box.curves),
        sum_up: (K, cost.w, cost.weight, 0.0, box.nodes, box.curves, box.sums),
        spread_of: (cost.A, box.half, box.nodes, box.curves, box.sums),
        least_residual: (K, cost.weight, 0.0, box.half, box.nodes, box.rows),
        is_left: (atlas, box, 1),
    }
    for kernel, arguments in calls.items():
        assert borrows(kernel, arguments), kernel
