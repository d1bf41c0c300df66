"""Arcs: closed around a line, through a mirror image, and as likely along them as samples are."""

import numpy as np
import pytest
from scipy.stats import t as student_law
from uncertainty.scenes import fixed

from optloc.problem.chart import CURVED
from optloc.uncertainty import samples, trace_arc
from optloc.uncertainty.arc import student
from optloc.uncertainty.region import RegionSurface


def test_points_of_a_student_distribution_have_its_quantiles_and_density():
    spare, points, log_density = student(1, 4096, 3)
    law = student_law(5.0)
    for values, share in ((points[:, 0], law.cdf), (spare, lambda value: value)):
        for q in (0.05, 0.3, 0.5, 0.95):
            assert share(np.quantile(values, q)) == pytest.approx(q, abs=0.005)
    expected = law.logpdf(points[:, 0]) - law.logpdf(0.0)
    np.testing.assert_allclose(log_density, expected, atol=1e-9)


def test_an_arc_around_a_line_closes():
    problem, truth, fix = fixed("line", 1)
    arc = trace_arc(problem, fix)
    assert arc.closed
    assert (arc.node[0] == arc.node[-1]).all()
    # A circle around the line of the stations, all of it as far off as the target.
    assert np.linalg.norm(arc.position[:, 1:], axis=1) == pytest.approx(np.linalg.norm(truth[1:]), rel=0.01)
    assert 100 < len(arc.node) < 500
    share, beside = arc.locate(arc.position[[5, 40]])
    assert beside == pytest.approx(0.0, abs=1e-6)
    assert 0 < share[0] < share[1] < 1
    assert arc.mass.sum() == pytest.approx(1)


def test_an_arc_goes_through_the_mirror_image():
    """Stations in a plane but for 50 m: the other side of it costs little more, and the arc leads there."""
    problem, _, fix = fixed("plane 50 400", 0)
    arc = trace_arc(problem, fix)
    assert not arc.closed
    assert not arc.far
    assert arc.position[:, 2].min() < -300
    assert arc.position[:, 2].max() > 300
    assert (arc.cost[[0, -1]] - fix.cost > 25).all()
    assert 30 < len(arc.node) < 90


def along_arcs(name, n):
    share, beside = [], []
    for item in range(n):
        problem, truth, fix = fixed(name, item)
        if RegionSurface.of(problem, fix).kind == CURVED:
            found = trace_arc(problem, fix).locate(truth[None])
            share.append(found[0][0])
            beside.append(found[1][0])
    return np.array(share), np.array(beside)


@pytest.mark.full
@pytest.mark.parametrize(("name", "n"), [("plane 50 400", 120), ("plane 200 1000", 400), ("line", 60)])
def test_the_truth_lies_along_the_arc_as_promised(name, n):
    share, beside = along_arcs(name, n)
    assert len(share) > 40
    width = 3 * np.sqrt(0.95 * 0.05 / len(share))
    # Measured: 92.5 to 98.3 % within the central 95 %, across 94.0 to 97.2 %.
    assert abs(((share > 0.025) & (share < 0.975)).mean() - 0.95) < width
    # Two numbers across the arc: chi-square with two degrees of freedom.
    assert abs((beside**2 < 5.99).mean() - 0.95) < width


@pytest.mark.parametrize("name", ["plane 50 400", "line"])
def test_samples_along_an_arc_are_the_likelihood(name):
    """Shares along the curve, by samples with weights and by the curve's own mass."""
    problem, _, fix = fixed(name, 0)
    arc, found = trace_arc(problem, fix), samples(problem, fix, 4096, 1)
    assert found.prior == "arc"
    assert found.effective > 0.5 * 4096
    share = arc.locate(found.position)[0]
    for edge in (0.1, 0.5, 0.9):
        assert found.weight[share < edge].sum() == pytest.approx(edge, abs=0.03)
