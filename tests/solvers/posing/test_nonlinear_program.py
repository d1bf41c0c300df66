"""A nonlinear program that users change: solutions and failures by the names of relations."""

import casadi as ca
import numpy as np
import pytest
from solvers.posing.scenes import ranged

from optloc import InvalidProblem
from optloc.solvers.posing.nonlinear_program import NonlinearProgram
from optloc.solvers.posing.posed_problem import PosedProblem
from optloc.solvers.posing.programs import pose_program


def test_a_dual_is_the_slope_in_the_units_of_the_user():
    def at(e):
        own = NonlinearProgram(pose_program(ranged(2).flat(), None))
        posed = PosedProblem(own)
        posed.add(ca.vertcat(own.vector[0] <= place[0] - 5.0 + e, own.vector[1] == place[1] + 5.0), name="it")
        (end, *_), failure = own.solve(own.starts()[:1], "ipopt", {}, None)
        assert end.success
        assert failure == ""
        return own.solution(end)

    free = NonlinearProgram(pose_program(ranged(2).flat(), None))
    place, step = free.starts()[0], 1e-2
    found = at(0.0)
    assert found.duals["it"][0] == pytest.approx(-(at(step).value - at(-step).value) / (2.0 * step), rel=1e-4)
    assert found.values["it"] == pytest.approx(np.zeros(2), abs=1e-6)
    assert found.backend.worst < 1e-6


def test_failures_have_no_numbers_and_no_solver_is_guessed():
    own = NonlinearProgram(pose_program(ranged(2).flat(), None))
    PosedProblem(own).add(own.vector[0] <= 3.0, name="it")
    found = own.no_solution("ipopt", "stopped")
    assert np.isnan(found.duals["it"])
    assert np.isnan(found.value)
    assert found.backend.message == "stopped"
    with pytest.raises(InvalidProblem, match="no nonlinear solver"):
        own.solve(own.starts(), "nosuch", {}, None)
    assert own.kinks() == ""
