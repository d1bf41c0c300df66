"""A numerical failure of one problem is its status: in every method linear algebra is made to fail, once and again."""

import sys
import warnings
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from inspect import isfunction
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg
from often import few

from optloc import Status, assemble, certify, measured, prepare, simulate, solve
from optloc.base import linalg
from optloc.engine import plan
from optloc.solvers import METHODS, SOLVERS, single
from optloc.solvers.certificates import admitted

STATIONS = np.array([[0.0, 0.0], [1000.0, 0.0], [0.0, 1000.0], [1000.0, 1100.0], [500.0, -300.0]])
PLACE = np.array([300.0, 400.0])


def ranged(count=2, **rows):
    rows = rows or {"range": {"a": np.arange(5), "sigma": 1.0}}
    made = assemble(STATIONS, *(measured(kind, **more) for kind, more in rows.items()))
    return simulate(made, np.tile(PLACE, (count, 1)), 3)


def sighted(count=2):
    return ranged(count, azimuth={"a": np.arange(5), "sigma": 1e-3})


def whole(word):
    """A method with this word in it that ends in fixes."""
    entry = SOLVERS[word]
    return f"{word}+lsr" if entry.role == "start" else word if word == "gtrs+lsr" else f"roots+lsr+{word}"


SIGHTED = ("wiv", "minimax", "bound")
EVERY = sorted({*METHODS, "gtrs+lsr", *map(whole, SOLVERS)})
SHORT = ["gtrs+lsr", "proven", "robust", "sdp+lsr"]
# Of "gtrs+lsr" no stages have these names.
STAGED = [each for each in reversed(EVERY) if each != "gtrs+lsr"]
METHOD = pytest.mark.parametrize("method", EVERY)


@cache
def problem(method, count=2):
    if "directions" in method:  # in space alone
        sight = measured("azimuth", a=np.arange(5), sigma=1e-3), measured("elevation", a=np.arange(5), sigma=1e-3)
        return simulate(assemble(np.c_[STATIONS, 100.0 * np.arange(5)], *sight), np.tile([*PLACE, 50.0], (count, 1)), 3)
    made = sighted(count) if any(word in method for word in SIGHTED) else ranged(count)
    if method == "robust" or "suspects" in method:  # something to be suspected
        made = made.with_rows(z=made.z + 60.0 * np.eye(made.count)[1])
    return made


@cache
def undisturbed(method, count=2):
    return solve(problem(method, count), method)


# Linear algebra that fails on demand.

OWN = ("optloc", "formulations")


def functions():
    for module in (np.linalg, scipy.linalg, linalg):
        for name, value in vars(module).items():
            public = not name.startswith("_") and callable(value) and not isinstance(value, type)
            if public and (module is not linalg or (isfunction(value) and value.__module__ == linalg.__name__)):
                yield module, name, value


@contextmanager
def watched(monkeypatch, decide):
    """Let `decide` see each call of linear algebra that optloc makes, (place, arguments), before it is made."""

    def guard(name, function):
        def guarded(*args, **options):
            frame = sys._getframe(1)
            if frame.f_globals["__name__"].partition(".")[0] in OWN:
                decide((name, frame.f_code.co_filename, frame.f_lineno), args)
            return function(*args, **options)

        return guarded

    for kept in (plan._KEPT, single._KEPT):  # what was made before would not fail again
        kept.clear()
    with monkeypatch.context() as patch:
        for module, name, value in list(functions()):
            patch.setattr(module, name, guard(name, value))
        yield


def places(monkeypatch, method):
    found, batch = {}, problem(method)
    with watched(monkeypatch, lambda place, args: found.setdefault(place)):
        solve(batch, method)
    return list(found)


def fail_once(at):
    left = [at]

    def decide(place, args):
        if left and place == left[0]:
            left.clear()
            raise np.linalg.LinAlgError("injected")

    return decide


def check(monkeypatch, method, place):
    """A batch is solved wherever it fails once, each problem alone; that of a single problem is its status."""
    batch, expected = problem(method), undisturbed(method)
    with watched(monkeypatch, fail_once(place)):
        fix = solve(batch, method)
    assert fix.code.tolist() == expected.code.tolist(), (method, place)
    np.testing.assert_allclose(fix.x, expected.x, atol=1e-3, err_msg=f"{method} {place}")
    with watched(monkeypatch, fail_once(place)):
        one = solve(batch.take(np.array([0])), method)[0]
    if one.status == Status.NUMERICAL:
        assert str(one.reason).endswith(": injected")
        assert np.isnan(one.x).all()
        assert one.position.shape == fix.position.shape[1:]
        return True
    # a call that only batches make, or one that has something else to try
    assert one.status == expected[0].status, (method, place)
    return False


@pytest.mark.parametrize(
    ("methods", "least"), [(SHORT, 7), pytest.param(EVERY, 50, marks=pytest.mark.full)], ids=["short", "every"]
)
def test_each_call_of_linear_algebra_may_fail_once(monkeypatch, methods, least):
    """Each place in the code once, in the first method that comes there (of few methods every fourth place)."""
    seen, told = set(), 0
    for method in methods:
        found = places(monkeypatch, method)
        new = [place for place in found if place not in seen] or found[-1:]
        for place in new[:: 4 if methods is SHORT else 1]:
            told += check(monkeypatch, method, place)
        seen |= set(found)
    assert len(seen) > 50, "whatever optloc calls is seen"
    assert told > least


@pytest.mark.full
@METHOD
def test_each_call_of_each_method_may_fail_once(monkeypatch, method):
    told = sum(check(monkeypatch, method, place) for place in places(monkeypatch, method))
    # machine code calls nothing that fails, and where its maps cannot be made the stages go on
    assert told or method in ("auto", "gtrs+lsr")


@pytest.mark.parametrize("method", few(STAGED, 12))
def test_what_fails_for_good_takes_nobody_with_it(monkeypatch, method):
    """The third of five problems cannot be worked on by the last stage: the other four are fixed as ever."""
    word = METHODS.get(method, method).partition("|")[0].split("+")[-1]
    many, expected, entry = problem(method, 5), undisturbed(method, 5), SOLVERS[word]
    culprit = many.z[2].tobytes()

    def stage(some, pool):
        if culprit in [row.tobytes() for row in some.z]:
            raise FloatingPointError("divided by zero")
        return entry.run(some, pool)

    monkeypatch.setitem(SOLVERS, word, replace(entry, stage=stage))
    monkeypatch.setattr("optloc.solvers.solution.at_once", lambda *_: None)  # which goes past the stages
    fix = solve(many, method)
    assert fix[2].status == Status.NUMERICAL
    assert fix[2].reason == f"{word}: divided by zero"
    others = [0, 1, 3, 4]
    assert fix.code[others].tolist() == expected.code[others].tolist()
    np.testing.assert_allclose(fix.x[others], expected.x[others], atol=1e-3)


@METHOD
def test_empty_batches_give_empty_fixes(method):
    none = problem(method).take(np.arange(0))
    fix = solve(none, method)
    assert fix.shape == (0,)
    d = none.dimension
    assert fix.position.shape == (0, d)
    assert fix.gaussian()[1].shape == (0, d, d)


@pytest.mark.parametrize("error", [TypeError, ValueError, AssertionError, RuntimeError])
def test_programming_errors_surface(monkeypatch, error):
    def stage(some, pool):
        raise error("a bug")

    monkeypatch.setitem(SOLVERS, "lsr", replace(SOLVERS["lsr"], stage=stage))
    with pytest.raises(error, match="a bug"):
        solve(ranged(), "roots+lsr")


def test_what_solvers_raise_is_a_failure_of_numbers(monkeypatch):
    def broken(*args, **options):
        raise RuntimeError("no memory")

    import clarabel

    monkeypatch.setattr(clarabel, "DefaultSolver", lambda *args: SimpleNamespace(solve=broken))
    fix = solve(ranged(), "sdp+lsr")
    assert (fix.code == Status.NUMERICAL).all()
    assert fix.reason[0] == "sdp: Clarabel failed: no memory"


def test_proofs_that_are_asked_for_apart_are_contained_too(monkeypatch):
    many = ranged(3)
    fix = solve(many, "gtrs+lsr")
    expected = certify(many, fix)
    culprit, prove = many.z[1].tobytes(), admitted.certified

    def fail(some, *args):
        if culprit in [row.tobytes() for row in some.z]:
            raise np.linalg.LinAlgError("injected")
        return prove(some, *args)

    monkeypatch.setattr(admitted, "certified", fail)
    found = certify(many, fix)
    assert (found[1].status, found[1].reason) == (Status.NUMERICAL, "certify: injected")
    assert found.code[[0, 2]].tolist() == expected.code[[0, 2]].tolist()


def test_prepared_fixes_are_contained_too(monkeypatch):
    """The direct way fails, and so does the long one for a single problem of many."""
    many = ranged(5)
    ready = prepare(many.take(np.array([0])))

    def fail(*args):
        raise np.linalg.LinAlgError("injected")

    monkeypatch.setattr("optloc.solvers.prepared.settle_by_plan", fail)
    fix = ready(many.z)
    np.testing.assert_allclose(fix.x, solve(many, "gtrs+lsr").x, atol=1e-3)


def test_values_that_overflow_are_judged_without_a_warning():
    """Four thousand decibels are a ratio that has no square in a double."""
    z = [1.66, -4190.0, 8.13, 0.09]
    rows = assemble(STATIONS, measured("rss_difference", z, a=[1, 2, 3, 4], b=0, sigma=0.1))
    with warnings.catch_warnings(action="error"):
        fix = solve(rows)
    assert fix.status != Status.OK
