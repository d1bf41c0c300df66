"""What pictures share: names as they are, units that read well, ellipses of 95 %, and files by their endings."""

import numpy as np
import pytest
from scipy.stats import chi2
from show.ranging import ranged

from optloc import InvalidProblem
from optloc.show.pictures.style import (
    PLAN,
    ellipse_line,
    literal,
    panels_for,
    save,
    scene_of,
    states_of,
    thinned,
    unit_of,
    xy,
)


def test_text_is_shown_letter_by_letter():
    assert literal("a $x$") == r"a \$x\$"
    assert literal("_hidden") == " _hidden"
    assert literal("a\n  b") == "a b"
    assert len(literal("x" * 500)) == 120


@pytest.mark.parametrize(("reach", "unit"), [(0.5, "mm"), (20.0, "m"), (4999.0, "m"), (5000.0, "km")])
def test_lengths_are_in_the_unit_that_reads_best(reach, unit):
    assert unit_of(np.array([[0.0, -reach], [np.nan, 0.1]]))[0] == unit


def test_a_ring_is_where_the_chi_square_is_that_of_95_percent():
    cov = np.array([[9.0, 2.0], [2.0, 4.0]])
    edge = ellipse_line(cov)
    assert np.einsum("ni,ij,nj->n", edge, np.linalg.inv(cov), edge) == pytest.approx(
        np.full(len(edge), chi2.ppf(0.95, 2))
    )
    assert edge[0] == pytest.approx(edge[-1])


def test_a_long_track_keeps_its_ends():
    track = np.arange(2000.0).reshape(1000, 2)
    found = thinned(track)
    assert len(found) < 300
    assert np.array_equal(found[[0, -1]], track[[0, -1]])
    assert np.array_equal(thinned(track[:5]), track[:5])


def test_a_scene_has_the_numbers_of_the_fix():
    problem, fix = ranged()
    scene = scene_of(problem, [fix])
    assert scene.fixes.tolist() == [fix.position.tolist()]
    assert scene.covariances[0] == pytest.approx(fix.covariance())
    assert scene.clean.tolist() == [True]
    assert np.array_equal(scene.moved(lambda place: place + 1.0).stations, scene.stations + 1.0)
    ((position, _, clean),) = states_of(fix)
    assert (position.tolist(), clean.tolist()) == (scene.fixes.tolist(), [True])
    assert [v.tolist() for v in xy(scene.fixes, PLAN, 1e3)] == [[v / 1e3] for v in fix.position]


def test_pictures_are_written_by_their_ending(tmp_path):
    figure, panels = panels_for(3, 2, 1.0, 1.0)
    assert (len(panels), len(figure.axes)) == (3, 4)
    save(figure, tmp_path / "p.svg")
    assert (tmp_path / "p.svg").read_text(encoding="utf-8").lstrip().startswith("<?xml")
    with pytest.raises(InvalidProblem, match=r"type '\.doc'"):
        save(figure, tmp_path / "p.doc")
