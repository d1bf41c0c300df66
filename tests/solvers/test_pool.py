"""Pools of candidates: slots, parts of a batch, and failures that stay with their problem."""

from dataclasses import replace

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE

from optloc import Status, assemble, measured
from optloc.problem.fix_parts import Stage
from optloc.solvers.pool import _sum_stages, begin, chunk_size, in_parts, noting_place, offer, pack


@pytest.fixture
def problem():
    z = np.linalg.norm(PLACE - SQUARE, axis=1) + np.arange(6.0)[:, None]
    return assemble(SQUARE, measured("range", z, a=np.arange(5), sigma=1.0)).flat()


def test_finite_points_come_first_and_empty_slots_go():
    nan = [np.nan, np.nan]
    points = np.array([[nan, [1.0, 2.0], nan, [3.0, 4.0]], [nan, nan, [5.0, 6.0], nan]])
    packed = pack(points)
    assert packed.shape == (2, 2, 2)
    assert packed[0].tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert packed[1, 0].tolist() == [5.0, 6.0]
    assert np.isnan(packed[1, 1]).all()


def test_a_failure_is_that_of_its_problem_alone(problem):
    def work(part, own):
        with noting_place("the square root"):
            if (part.z[:, 0] == problem.z[3, 0]).any():
                raise np.linalg.LinAlgError("Singular matrix")
        return begin(part, np.tile(part.z[:, :1], 2))

    def failed(part, cause):
        blank = begin(part, np.full((part.batch_shape[0], 2), np.nan))
        return replace(blank, remark=np.full(len(blank), cause, dtype=object))

    with pytest.raises(np.linalg.LinAlgError):
        in_parts(problem, work)
    pool = in_parts(problem, work, 4, failed)
    assert np.flatnonzero(pool.empty).tolist() == [3]
    assert pool.remark[3] == "the square root: Singular matrix"
    kept = np.delete(np.arange(6), 3)
    np.testing.assert_array_equal(pool.x[kept, 0, 0], problem.z[kept, 0])


def test_starts_are_offered_behind_the_stages_before(problem):
    first = begin(problem, np.zeros((6, 2)))
    pool = offer(problem, np.zeros((6, 3, 2)), first, "again", 0.0)
    assert [stage.name for stage in pool.stages] == ["start", "again"]
    assert pool.x.shape == (6, 3, 2)
    assert pool.dof.tolist() == [3] * 6
    assert not pool.empty.any()


def test_the_first_reason_for_no_candidate_stays(problem):
    pool = begin(problem, np.full((6, 2), np.nan))
    pool = pool.without(np.array([1, 2]), "too steep", Status.UNAVAILABLE)
    pool = pool.without(np.array([2, 3]), "failed", Status.NUMERICAL)
    assert pool.missing.reason.tolist() == ["", "too steep", "too steep", "failed", "", ""]
    assert pool.missing.code[3] == Status.NUMERICAL


def test_merged_items_replace_those_of_their_numbers(problem):
    pool = begin(problem, np.zeros((6, 2)))
    other = begin(problem.take(np.array([4, 0])), np.array([[4.0, 4.0], [1.0, 1.0]]))
    merged = pool.merge(np.array([4, 0]), other, Stage("merge", "", 0.0))
    assert merged.x[:, 0, 0].tolist() == [1.0, 0.0, 0.0, 0.0, 4.0, 0.0]
    assert merged.stages[-1].name == "merge"


def test_seconds_of_parts_are_summed_and_crowds_are_never_empty(problem):
    parts = [(Stage("a", "x", 1.0),), (Stage("a", "x", 2.0), Stage("b", "y", 0.5))]
    assert [(stage.name, stage.seconds) for stage in _sum_stages(parts)] == [("a", 3.0), ("b", 0.5)]
    assert chunk_size(problem) == 2**12 // 5
