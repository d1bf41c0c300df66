"""A chunk's table against sums done by hand; trials that fail cost their row."""

import numpy as np
import pytest
from lab.study.texts import design

import optloc
from optloc.lab.study import trial
from optloc.lab.study.design import Chunk
from optloc.lab.study.methods import run
from optloc.lab.study.simulation import draw
from optloc.lab.study.trial import COLUMNS, DIED, arrow_schema, compute


def frame(made):
    return compute(made).table.to_pandas()


def test_columns_are_what_they_say():
    made = next(design().chunks)
    found, drawn = frame(made), draw(made.cell.case, 0, 10)
    assert compute(made).table.schema.equals(arrow_schema())
    assert list(found) == [column.name for column in COLUMNS]
    fix = optloc.solve(drawn.problem, "gtrs+lsr")
    error = fix.position - drawn.truth
    assert np.allclose(found[["error_x", "error_y", "error_z"]], error)
    assert np.allclose(found["error"], np.linalg.norm(error, axis=1))
    bound = optloc.crlb(drawn.problem, drawn.truth)
    assert np.allclose(found["crlb"], np.sqrt(np.trace(bound, axis1=1, axis2=2)))
    for i in range(10):
        assert found["nees"][i] == pytest.approx(error[i] @ np.linalg.solve(fix.cov[i], error[i]))
        assert found["deviation"][i] ** 2 == pytest.approx(error[i] @ np.linalg.solve(bound[i], error[i]))
        # Differences to the first station: covariance and cost written out.
        weight = np.linalg.inv(0.5 * (np.eye(5) + 1.0))
        for name, place in (("cost", fix.position[i]), ("cost_truth", drawn.truth[i])):
            far = np.linalg.norm(drawn.problem.stations.position[i, 0] - place, axis=1)
            left = drawn.problem.z[i] - (far[1:] - far[0])
            assert found[name][i] == pytest.approx(left @ weight @ left)
    assert (found["cost"] <= found["cost_truth"]).all()
    assert set(found["status"]) == {"unproven"}  # of a method without a proof
    assert (found["seconds"] > 0.0).all()


def test_costs_of_unrefined_starts_are_those_of_the_likelihood():
    text = 'format = 1\nname = "x"\ntrials = 20\n[[scenario]]\nname = "s"\nlayout = { kinds = ["toa"] }\n'
    text += 'truth = { kind = "hull" }\nnoise = ["3 m"]\n[[method]]\nmethod = ["gtrs", "gtrs+lsr"]\n'
    rough, fine = (frame(made) for made in design(text).chunks)
    assert (rough["located"] & ~rough["answered"]).all()
    assert (rough["cost"] >= fine["cost"] - 1e-9).all()
    assert (rough["cost"] - fine["cost"]).median() < 5.0


def test_a_failing_trial_costs_its_row(monkeypatch):
    made = next(design().chunks)
    whole, bad, solved = frame(made), draw(made.cell.case, 4, 1).truth, run

    def brittle(method, drawn):
        if (drawn.truth == bad).all(-1).any():
            raise FloatingPointError("no such luck")
        return solved(method, drawn)

    monkeypatch.setattr(trial, "run", brittle)
    found = frame(made)
    assert found["status"].tolist() == ["unproven"] * 4 + [DIED] + ["unproven"] * 5
    assert found["reason"][4] == "FloatingPointError: no such luck"
    assert np.isnan(found["error"][4])
    assert found["truth_x"].equals(whole["truth_x"])
    others = found.drop(index=4)["error"]
    assert np.allclose(others, whole.drop(index=4)["error"])


def test_a_chunk_in_which_all_trials_fail_keeps_what_is_known_of_them(monkeypatch):
    made = next(design().chunks)
    whole = frame(made)

    def broken(method, drawn):
        raise FloatingPointError

    monkeypatch.setattr(trial, "run", broken)
    found = frame(made)
    assert set(found["status"]) == {DIED}
    for name in ("truth_x", "crlb", "cost_truth", "noise"):
        assert found[name].equals(whole[name]), name


def test_chunks_cover_every_trial_once():
    text = design().text.replace("trials = 60", "trials = 1237")
    made = design(text)
    seen = {}
    for one in made.chunks:
        assert isinstance(one, Chunk)
        seen.setdefault(one.cell.key, []).extend(range(one.first, one.first + one.count))
    assert len(seen) == len(made.cells) == 6
    assert all(sorted(trials) == list(range(1237)) for trials in seen.values())
    assert made.rows == 6 * 1237


@pytest.mark.parametrize(("method", "solver"), [("sdp+lsr", "SCS"), ("gtrs+nlp", "sqpmethod"), ("gtrs+nlp", "ipopt")])
def test_other_back_ends_find_the_same_points(method, solver):
    text = 'format = 1\nname = "x"\ntrials = 6\n[[scenario]]\nname = "s"\nlayout = { stations = 6 }\n'
    text += 'truth = { kind = "hull" }\nnoise = ["3 m"]\n[[method]]\nmethod = "gtrs+lsr"\n'
    text += f'[[method]]\nmethod = "{method}"\nsolver = "{solver}"\n'
    plain, other = (frame(made) for made in design(text).chunks)
    assert set(other["solver"]) == {solver}
    assert (other["iterations"] > 1.0).all()
    assert np.allclose(other[["error_x", "error_y", "error_z"]], plain[["error_x", "error_y", "error_z"]], atol=1e-2)


def test_settings_reach_the_solver():
    text = 'format = 1\nname = "x"\ntrials = 5\n[[scenario]]\nname = "s"\nlayout = { stations = 6 }\n'
    text += 'truth = { kind = "hull" }\nnoise = ["3 m"]\n'
    text += '[[method]]\nname = "a"\nmethod = "sdp"\nsolver = "SCS"\n'
    text += '[[method]]\nname = "b"\nmethod = "sdp"\nsolver = "SCS"\nsettings = { max_iters = 7 }\n'
    free, held = (frame(made) for made in design(text).chunks)
    assert held["iterations"].max() <= 14.0  # two weightings
    assert free["iterations"].min() > 14.0


def test_a_solver_without_a_program_is_refused():
    text = design().text.replace('method = "gtrs+lsr"', 'method = "gtrs+lsr"\nsolver = "SCS"')
    with pytest.raises(optloc.InvalidProblem, match="no program that SCS solves"):
        compute(next(design(text).chunks))
