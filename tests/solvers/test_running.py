"""A running solution: epochs added one by one or in stretches give the solution of the whole run."""

import numpy as np
import pytest
from often import few
from runs import drawn, estimated, run, truth

import optloc
from optloc.base.errors import InvalidProblem
from optloc.base.types import Motion
from optloc.problem.epochs import cut
from optloc.solvers.running import _space_counts, growing


@pytest.mark.parametrize("case", few(["moving", "eliminated", "fixed", "prior, gains"], 2))
def test_updates_reach_the_whole_solution(case):
    problem = {
        "fixed": run(300),
        "moving": run(300, order=1, step=2.0),
        "prior, gains": run(200, prior=100.0, gain=3e-4),
        "eliminated": estimated(run(60, prior=100.0)),
    }[case]
    problem, half = drawn(problem, 7, 2), problem.epochs // 2
    begun = cut(problem, 0, half)
    running = optloc.solvers.Running.begin(begun, optloc.solve(begun, "lsr", start=truth(begun)))
    for first in range(half, problem.epochs, 5):
        running = running.update(cut(problem, first, min(first + 5, problem.epochs)))
    whole = optloc.solve(problem, "lsr", start=truth(problem))
    n = problem.layout.n_shared
    assert (np.abs(running.x - whole.x[:, :n]) < 0.01 * whole_sigma(whole)).all()
    np.testing.assert_allclose(np.diagonal(running.cov, axis1=1, axis2=2), whole_sigma(whole) ** 2, rtol=0.05)
    assert running.linearised < 1 + (problem.epochs - half) // 5
    np.testing.assert_allclose(running.fix().cost, whole.cost, rtol=1e-9)


def whole_sigma(fix):
    return np.sqrt(np.diagonal(fix.cov, axis1=-2, axis2=-1))


def test_a_large_step_is_linearised_anew():
    """A solution of a wrong half-metre-a-second course jumps when the truth arrives: the sums alone would be wrong."""
    problem = drawn(run(400), 8, 1)
    early = cut(problem, 0, 60)
    running = optloc.solvers.Running.begin(early, optloc.solve(early, "lsr", start=truth(early)))
    before = running.linearised
    running = running.update(cut(problem, 60, 400))
    assert running.linearised == before + 1
    whole = optloc.solve(problem)
    assert (np.abs(running.x - whole.x) < 1e-4 * whole_sigma(whole)).all()


def test_refusals():
    problem = drawn(run(40, prior=200.0), 9, 1)
    lost = optloc.solve(problem)
    lost.x[:] = np.nan
    with pytest.raises(InvalidProblem, match="no answer to start from"):
        optloc.solvers.Running.begin(problem, lost)
    rows = optloc.measured("range", np.ones(4), a=[0, 1, 0, 1], epoch=[0, 0, 1, 1], sigma=1.0)
    free = optloc.assemble([[0.0, 0.0], [1.0, 0.0]], rows, motions=(Motion(span="epoch"),))
    with pytest.raises(InvalidProblem, match="free at each epoch"):
        optloc.solvers.Running.begin(free, lost)


def test_an_estimate_grows_into_that_of_the_whole_run():
    problem = run(30)
    problem = optloc.simulate(problem, truth=truth(problem), seed=7)
    fix = optloc.solve(problem, "lsr", start=truth(problem))
    found, n = growing(problem, fix, [10, 20, 30]), problem.layout.n_shared
    np.testing.assert_allclose(found.x[-1], fix.x[:n], atol=1e-2)
    _, sigma = found.take("position")
    assert (np.diff(np.linalg.norm(sigma, axis=1)) < 0.0).all()
    with pytest.raises(InvalidProblem, match="counts are not among 1 to 30"):
        growing(problem, fix, [31])


def test_answers_of_a_long_run_are_closer_together_at_its_start():
    assert _space_counts(5).tolist() == [1, 2, 3, 4, 5]
    far = _space_counts(10_000)
    assert (far[0], far[-1]) == (1, 10_000)
    assert len(far) <= 60
    assert (np.diff(np.diff(far)) >= -1).all()
