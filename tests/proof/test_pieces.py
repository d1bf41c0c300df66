"""Boxes on the pieces of an atlas: what a cut leaves, and what reaches infinity."""

import numpy as np
import pytest

from optloc.proof.atlas import atlas_of, set_centre, write_position
from optloc.proof.box import CENTRE, DEPTH, HALF, LEAST, PIECE
from optloc.proof.pieces import (
    contract_at_infinity,
    is_listed,
    is_tiny,
    push_faces,
    push_or_defer,
    push_pieces,
    push_rest,
    touches_infinity,
)
from optloc.proof.search_space import empty_box

pytestmark = pytest.mark.usefixtures("plainly")


def box_at(at, half):
    box = empty_box(1, 1)
    box.at[:], box.half[:] = at, half
    box.cut[:3], box.cut[3:] = -box.half, box.half
    return box


@pytest.mark.parametrize("d", [2, 3])
def test_faces_and_inside_reach_every_direction_and_infinity(d):
    stack, atlas = np.zeros((16, DEPTH)), atlas_of(np.zeros(3), 1e3, d, 0)
    assert push_faces(stack, d) == push_pieces(stack, atlas) == 2 * d + 1
    assert stack[: 2 * d + 1, PIECE].tolist() == list(range(2 * d + 1))
    # the last coordinate of a face ends at zero, infinity
    assert (stack[: 2 * d, CENTRE + d - 1] == stack[: 2 * d, HALF + d - 1]).all()
    x, ways = np.empty(d), set()
    for row in stack[: 2 * d]:
        set_centre(atlas, int(row[PIECE]), row[CENTRE : CENTRE + 3])
        write_position(atlas, x)
        ways.add((int(np.argmax(np.abs(x))), bool(x[np.argmax(np.abs(x))] > 0.0)))
    assert len(ways) == 2 * d


def test_a_box_beyond_infinity_is_cut_off_there():
    box = box_at([0.0, 0.3, 0.0], [0.1, 0.4, 0.0])
    assert touches_infinity(box, 1, 0.0)
    contract_at_infinity(box, 1, 0.0)
    assert box.at[1] - box.half[1] == pytest.approx(0.0, abs=1e-11)
    assert box.at[1] + box.half[1] == pytest.approx(0.7)
    assert not touches_infinity(box_at([0.0, 0.3, 0.0], [0.1, 0.2, 0.0]), 1, 0.0)


def test_what_is_left_is_halved_if_it_is_large_and_kept_whole_if_it_is_small():
    stack = np.zeros((8, DEPTH))
    assert push_rest(stack, 0, np.array([-1.0, -1, 0, 1, 1, 0]), np.zeros(3), np.array([1.0, 1, 0]), 0, 0.0, 4) == 2
    assert sorted(stack[:2, CENTRE]) == [-0.5, 0.5]
    at, half = np.zeros(3), np.array([1.0, 1.0, 0.0])
    assert push_rest(stack, 0, np.array([0.5, -1, 0, 1, 1, 0]), at, half, 0, 0.0, 4) == 1
    assert stack[0, CENTRE] == pytest.approx(0.75)
    assert stack[0, HALF] == pytest.approx(0.25)
    assert push_rest(stack, 0, np.array([0.5, -1, 0, 0.4, 1, 0]), np.zeros(3), np.ones(3), 0, 0.0, 4) == 0


def test_a_box_that_costs_more_than_a_level_waits():
    stack, aside = np.zeros((8, DEPTH)), np.zeros((8, DEPTH))
    box = box_at(np.zeros(3), [1.0, 1.0, 0.0])
    assert push_or_defer(stack, 0, aside, 0, box, 0, 3.0, 4, 4.0) == (0, 2)
    assert aside[0, LEAST] == 3.0
    box = box_at(np.zeros(3), [1.0, 1.0, 0.0])
    assert push_or_defer(stack, 0, aside, 0, box, 0, 1.0, 4, 4.0) == (2, 0)


def test_boxes_at_infinity_are_tiny_sooner_around_a_minimum():
    box = box_at(np.zeros(3), np.full(3, 1e-4))
    assert not is_tiny(box, 0, 3)
    assert is_tiny(box, 7, 3)


def test_a_place_in_the_box_of_a_minimum_is_listed():
    atlas = atlas_of(np.zeros(3), 1e3, 2, 1)
    atlas.minima.home[0] = 4
    atlas.minima.start[0] = [0.2, 0.1, 0.0]
    atlas.minima.back[0] = 100.0 * np.eye(3)
    atlas.minima.sides[0] = 2.0
    assert is_listed(atlas, np.array([215.0, 95.0]))
    assert not is_listed(atlas, np.array([225.0, 95.0]))
