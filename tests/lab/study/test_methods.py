"""Methods of a study file: their names, what decides their answers, settings, and answers that are none."""

import numpy as np
import pytest

from optloc.base.errors import InvalidProblem
from optloc.lab.study.document import MethodTable
from optloc.lab.study.methods import Nonsense, Setting, StudyMethod, _check_answers, added, check_settings, methods_of


def of(**table):
    return list(methods_of(MethodTable.model_validate(table), 1))


def test_lists_stand_for_one_method_each():
    names = [one.name for one in of(method=["gtrs+lsr", "sdp"], solver="CLARABEL")]
    assert names == ["gtrs+lsr (CLARABEL)", "sdp (CLARABEL)"]
    assert [one.name for one in of(name="mine", method=["auto", "gtrs"])] == ["mine: auto", "mine: gtrs"]
    (guessed,) = of(baseline="taylor", start="truth", width="2 km")
    assert (guessed.name, guessed.width) == ("taylor from the truth", 2000.0)


def test_what_knows_the_truth_is_a_reference():
    names = {one.name: one.reference for one in [*of(baseline="taylor"), *of(baseline=["truth"]), *of(method="auto")]}
    assert names == {"taylor from the centre": False, "truth": True, "auto": False}
    assert of(baseline="taylor", start="truth")[0].reference


def test_the_identity_is_of_what_decides_the_answers():
    one = StudyMethod("a", "gtrs+lsr", None)
    assert one.identity == StudyMethod("a", "gtrs+lsr", None, chunk=10).identity
    assert one.identity != StudyMethod("a", "gtrs+lsr", None, batch=1).identity
    assert one.identity != StudyMethod("a", "gtrs+lsr", None, settings={"max_iter": 3}).identity


def test_methods_that_a_user_names_are_baselines_or_methods():
    one, two = added(["taylor", "gtrs+lsr"])
    assert (one.baseline, one.method, two.baseline, two.method) == ("taylor", None, None, "gtrs+lsr")
    with pytest.raises(InvalidProblem, match="did you mean 'gtrs'"):
        added(["gtsr"])


def test_a_setting_takes_its_kind_within_its_range():
    count, size, switch = Setting(int, 1, 10), Setting(float, 0.0, 1.0), Setting(bool)
    assert [count.takes(value) for value in (1, 10, 11, 2.0, True)] == [True, True, False, False, False]
    assert [size.takes(value) for value in (0.5, 1, -0.1, "0.5", np.nan)] == [True, True, False, False, False]
    assert [switch.takes(value) for value in (True, 1)] == [True, False]
    check_settings("SCS", {"max_iters": 5}, "settings")
    with pytest.raises(InvalidProblem, match="settings: max_iters is 0"):
        check_settings("SCS", {"max_iters": 0}, "settings")


@pytest.mark.parametrize(
    ("cov", "words"),
    [
        ([[1.0, 0.5], [0.0, 1.0]], "not symmetric"),
        ([[1.0, 2.0], [2.0, 1.0]], "not positive semidefinite"),
        ([[-1.0, 0.0], [0.0, 1.0]], "negative variances"),
        ([[np.nan, 0.0], [0.0, 1.0]], "covariance is not finite"),
    ],
)
def test_a_covariance_that_is_none_is_nonsense(cov, words):
    _check_answers(np.zeros((1, 2)), np.array([[[4.0, 1e-3], [1e-3, 1e-6]]]))  # of units a thousand apart
    with pytest.raises(Nonsense, match=words):
        _check_answers(np.zeros((1, 2)), np.array([cov]))
