"""Squared rows of ranges: no position whose residual is short is clipped, and of large boxes little is left."""

import numpy as np
import pytest
from proof.layouts import BY_NAME
from proof.sampling import many

from optloc.proof.atlas import atlas_of, infinity_coordinate, piece_of, set_centre
from optloc.proof.box import station_cube
from optloc.proof.position_costs import position_costs
from optloc.proof.search_space import chart_at, cost_of, empty_box
from optloc.proof.squares import change_of_residual, clip_to_squares, squares_of

NAMES = (
    "TDOA, 5 stations, outside, 10 m",
    "TDOA, 6 stations, near-coplanar, outside, 30 m",
    "TOA, 6 stations, inside, 1 m",
)


def scenes(name, count, seed):
    """Return costs, tables of a box at the truth, squared rows, an atlas, and the truths."""
    problem, truth = BY_NAME[name].drawn(count, seed=seed)
    costs = position_costs(problem.flat())
    for i in range(count):
        K, data = costs.K[i if len(costs.K) > 1 else 0], costs.data[i if len(costs.data) > 1 else 0]
        cost, box = cost_of(costs.kinds, data, K, costs.w[i]), empty_box(*K.shape)
        chart_at(cost, truth[i], box)
        middle, radius = station_cube(cost.kinds, cost.data, truth[i])
        yield cost, box, squares_of(cost, box, middle, radius), atlas_of(middle, radius, 3, 0), truth[i]


def residuals(cost, x):
    """Return lengths of whitened residuals of positions (n, 3), by the definition."""
    ranges = np.linalg.norm(x[:, None] - cost.data[:, :3], axis=-1)
    return np.linalg.norm(ranges @ cost.K.T - cost.w, axis=-1)


def positions(atlas, piece, u):
    """Return the positions (n, 3) of coordinates (n, 3) of a face or the inside."""
    if piece == 6:
        return atlas.middle + atlas.radius * u
    p = np.insert(u[:, :2], piece // 2, 1.0 if piece % 2 else -1.0, axis=1)
    return atlas.middle + atlas.radius * p / u[:, 2:]


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize("name", NAMES)
def test_no_position_with_a_short_residual_is_clipped(name):
    """Boxes of any size around the truth or beside it; what is short is said by samples of the box themselves."""
    rng, lost, clipped = np.random.default_rng(1), 0, 0
    for cost, box, squares, atlas, x in scenes(name, many(60, 8), 1):
        assert squares.groups == 1
        assert squares.lack < 1e-9
        at = np.zeros(3)
        piece = piece_of(atlas, x, at)
        for _ in range(20):
            half = 10.0 ** rng.uniform(-4.0, 0.0, 3)
            centre = at + rng.uniform(-1.5, 1.5, 3) * half
            if piece < 6:
                half[2] = min(half[2], abs(centre[2]))
            box.at[:], box.half[:] = centre, half
            u = centre + rng.uniform(-1.0, 1.0, (200, 3)) * half
            if (np.abs(at - centre) <= half).all():
                u[0] = at
            if piece < 6:
                u = u[u[:, 2] > 0.0]
            if centre[2] <= 0.0 and piece < 6:
                continue
            length = residuals(cost, positions(atlas, piece, u))
            rho = np.quantile(length, rng.uniform(0.0, 0.5)) * (1.0 + 1e-6)
            set_centre(atlas, piece, box.at)
            left = clip_to_squares(cost, atlas, squares, rho, box)
            s = (u - centre)[length < rho]
            lost += not left or not ((s >= box.cut[:3]) & (s <= box.cut[3:])).all()
            clipped += left and (box.cut[3:] - box.cut[:3] < 1.8 * half).any()
    assert lost == 0
    assert clipped > many(200, 30)


@pytest.mark.usefixtures("form")
def test_of_all_space_little_is_left():
    """All faces and the inside, at the gap of a proof: most are gone at once, and the truth is in what is left."""
    share, gone, count = 0.0, 0, many(40, 4)
    for cost, box, squares, atlas, x in scenes(NAMES[0], count, 2):
        own = np.zeros(3)
        home = piece_of(atlas, x, own)
        for piece in range(7):
            box.at[:], box.half[:] = (0.0, 0.0, 0.0 if piece == 6 else 0.5), (1.0, 1.0, 1.0 if piece == 6 else 0.5)
            set_centre(atlas, piece, box.at)
            assert change_of_residual(atlas, squares, box.half) > 5.0
            left = clip_to_squares(cost, atlas, squares, 6.0, box)
            gone += not left
            if piece == home:
                s = own - box.at
                assert left
                assert (np.abs(s - 0.5 * (box.cut[3:] + box.cut[:3])) <= 0.5 * (box.cut[3:] - box.cut[:3])).all()
            share += np.prod(box.cut[3:] - box.cut[:3]) / np.prod(2.0 * box.half) if left else 0.0
    assert gone > 3 * count
    assert share / count < 1.0


@pytest.mark.usefixtures("form")
def test_where_rows_are_no_differences_of_ranges_there_are_none():
    for name in (
        "range, 5 stations, inside, 1 m",
        "AOA, 4 stations, inside, 5 mrad",
        "GROA, 6 stations, inside, 2 permille",
    ):
        for _, _, squares, _, _ in scenes(name, 2, 3):
            assert squares.groups == 0
    for _, _, squares, _, _ in scenes("AOA + TDOA, 4 stations, inside, 10 m", 2, 3):
        assert squares.groups == 1


@pytest.mark.usefixtures("form")
def test_infinity_is_reached_along_the_last_coordinate_where_axes_say_so():
    atlas = atlas_of(np.zeros(3), 1.0, 3, 1)
    assert [infinity_coordinate(atlas, piece) for piece in range(7)] == [0.0] * 6 + [-np.inf]
    minima = atlas.minima
    minima.home[0], minima.start[0], minima.axes[0] = 2, (0.1, -0.2, 0.5), np.triu(np.full((3, 3), 0.05))
    end = infinity_coordinate(atlas, 7)
    assert end == pytest.approx(-10.0, rel=1e-9)
    set_centre(atlas, 7, np.array([0.3, -0.4, end]))
    assert abs(atlas.scale[0]) < 1e-10
    minima.axes[0, 2, 0] = 0.01
    assert infinity_coordinate(atlas, 7) == -np.inf
    minima.home[0] = 6
    assert infinity_coordinate(atlas, 7) == -np.inf
