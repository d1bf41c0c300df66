import pickle
from types import SimpleNamespace

import numpy as np
import pytest

from optloc.base.errors import InvalidProblem, NoSolution, OptlocError, nearest
from optloc.base.types import Status


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("no rows",), "no rows."),
        (("unknown unit 'kms'.", "stations.csv"), "stations.csv: unknown unit 'kms'."),
        (("no rows", None, "add some."), "no rows; add some."),
        (("latitude 95 deg", "a.csv, row 3", "swap columns"), "a.csv, row 3: latitude 95 deg; swap columns."),
    ],
)
def test_invalid_problem_is_one_sentence(arguments, sentence):
    error = InvalidProblem(*arguments)
    assert str(error) == sentence
    assert isinstance(error, OptlocError)
    assert isinstance(error, ValueError)
    back = pickle.loads(pickle.dumps(error))
    assert (str(back), back.what, back.where, back.advice) == (sentence, error.what, error.where, error.advice)


def test_no_solution_says_why():
    error = NoSolution("problem", SimpleNamespace(status=Status.TOO_FEW_ROWS))
    assert str(error) == Status.TOO_FEW_ROWS.sentence
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_no_solution_of_a_batch_names_each_status_once():
    codes = np.array([Status.OK, Status.STALLED, Status.AMBIGUOUS, Status.STALLED])
    text = str(NoSolution(None, SimpleNamespace(status=codes)))
    assert text == f"{Status.STALLED.sentence} {Status.AMBIGUOUS.sentence}"


def test_no_solution_of_one_fix_has_the_sentence_of_the_fix():
    fix = SimpleNamespace(status=Status.UNPROVEN, shape=(), sentence="Use the method 'auto'.")
    assert str(NoSolution("problem", fix)) == "Use the method 'auto'."


def test_no_solution_without_a_fix():
    assert str(NoSolution(None, None)) == "There is no fix."


def test_nearest_ignores_case_and_lists_all():
    assert nearest("KM", ["m", "km", "nmi"]).startswith("did you mean 'km'")
    assert nearest("bogus", ["m", "km"]) == "known are m, km"


def test_a_message_that_ends_with_a_question_has_no_full_stop():
    assert str(InvalidProblem("there is no such file", "a.csv", "did you mean 'b.csv'?")).endswith("'b.csv'?")
    assert str(InvalidProblem("there is no such file", "a.csv", "check the name")).endswith("name.")
