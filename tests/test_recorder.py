"""The recorder: recordings round-trip, equal fixes compare equal, and each planted difference is listed."""

import copy
import json

import numpy as np
import pytest
from cases import CASES
from recorder.__main__ import main
from recorder.comparison import KINDS, Tolerance, compare
from recorder.listing import listing
from recorder.recording import Recording, plain, read, record, solved
from recorder.scope import REFINEMENTS, VARIANTS, own_words, scenes, shipped_methods

from optloc.solvers import METHODS

KEY = ("tdoa-2d", "clean", 0, "auto")
FIX = {
    "status": "ambiguous",
    "findings": ["ambiguous", "unchecked"],
    "reason": "another position costs 3.2 more",
    "estimate": {"position": [3100.0, 6200.0], "emission": [-1234.0]},
    "covariance": {"position": [[9.0, 1.0], [1.0, 4.0]]},
    "cost": 2.5,
    "dof": 3,
    "certificate": {
        "proof": "global",
        "reason": "proven best",
        "method": "branch and bound",
        "bound": 2.499997,
        "gap": 3e-6,
        "unique": True,
        "margin": 25.0,
        "boxes": 28,
        "region": None,
    },
    "alternatives": [{"estimate": {"position": [-800.0, 150.0], "emission": [0.0]}, "gap": 3.2}],
    "weights": [1.0, 1.0, 0.25],
    "suspects": [["station S3"], ["row 2"]],
    "stages": ["gtrs: 1 candidate"],
    "seconds": 0.25,
}
HEAD = {
    "format": 1,
    "optloc": "0.1.0",
    "code": "0123",
    "date": "2026-01-01",
    "machine": {"platform": "Linux", "blas": ["openblas"]},
    "fixes": 1,
}
SCENE = {"z": [1.0], "weight": [1.0], "truth": {"position": [3103.0, 6200.0], "emission": [-1234.0]}}


def recording(**changes):
    """Return a recording of one fix, some parts of which are changed: a double underscore is a step into a part."""
    fix = copy.deepcopy(FIX)
    for path, value in changes.items():
        *steps, last = path.split("__")
        part = fix
        for step in steps:
            part = part[step]
        part[last] = value
    return Recording(HEAD, {KEY[:3]: SCENE}, {KEY: fix})


def found(new, old=None, tolerance=None):
    """Return the groups of all differences to the recording without changes."""
    return [one.group for one in compare(old or recording(), new, tolerance or Tolerance())]


def rival(*position, gap=3.2):
    return {"estimate": {"position": list(position), "emission": [0.0]}, "gap": gap}


@pytest.mark.parametrize(
    ("changes", "groups"),
    [
        ({"error": "TypeError: bad"}, ["new exception"]),
        ({"status": "ok", "findings": ["unchecked"]}, ["status ambiguous -> ok"]),
        ({"findings": ["ambiguous"]}, ["findings changed"]),
        ({"estimate__position": [3100.0, 6200.00003]}, ["estimate moved"]),
        ({"estimate__emission": [-1233.0]}, ["estimate moved"]),
        ({"estimate__position": ["nan", "nan"]}, ["estimate lost"]),
        ({"estimate": {"position": [3100.0, 6200.0]}}, ["other unknowns"]),
        ({"covariance__position": [[9.1, 1.0], [1.0, 4.0]]}, ["covariance changed"]),
        ({"covariance__position": [[9.0, 1.1], [1.1, 4.0]]}, ["covariance changed"]),
        ({"covariance__position": [["nan", "nan"], ["nan", "nan"]]}, ["covariance lost"]),
        ({"cost": 2.6}, ["cost higher"]),
        ({"cost": 2.4}, ["cost lower"]),
        ({"cost": "nan"}, ["cost lost"]),
        ({"dof": 2}, ["degrees of freedom changed"]),
        ({"certificate__proof": "local"}, ["certificate weaker: global -> local"]),
        ({"certificate__proof": "other"}, ["certificate changed: global -> other"]),
        ({"certificate__unique": False, "certificate__margin": 0.0}, ["uniqueness lost"]),
        ({"certificate__margin": 16.0}, ["margin changed"]),
        ({"certificate__bound": 1.0}, ["bound of the certificate changed"]),
        ({"certificate__bound": "nan"}, ["bound of the certificate changed"]),
        ({"certificate__gap": 0.5}, ["gap of the certificate changed"]),
        ({"certificate__region": [[0.0, 0.0], [1.0, 1.0]]}, ["region of the certificate changed"]),
        ({"alternatives": []}, ["alternative lost"]),
        ({"alternatives": [rival(-800.0, 150.0), rival(900.0, 900.0)]}, ["new alternative"]),
        ({"alternatives": [rival(-800.0, 150.3)]}, ["alternative moved"]),
        ({"alternatives": [rival(-800.0, 190.0)]}, ["alternative lost", "new alternative"]),
        ({"alternatives": [rival(-800.0, 150.0, gap=3.3)]}, ["gap of an alternative changed"]),
        ({"weights": [1.0, 1.0, 0.3]}, ["weights changed"]),
        ({"weights": [1.0, 1.0]}, ["weights of other rows"]),
        ({"suspects": [["row 2"], ["station S3"]]}, ["suspects changed"]),
        (
            {"reason": "a rival costs 3.2 more"},
            ["reason of the fix: 'another position costs # more' -> 'a rival costs # more'"],
        ),
        ({"certificate__method": "bounds"}, ["method of the certificate: 'branch and bound' -> 'bounds'"]),
    ],
)
def test_a_planted_difference_is_listed(changes, groups):
    assert found(recording(**changes)) == groups


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"seconds": 9.0, "certificate__boxes": 40, "stages": ["gtrs: 2 candidates"]},  # work, not a part of the answer
        {"reason": "another position costs 3.3 more"},  # numbers of texts are compared as numbers elsewhere
        {"estimate__position": [3100.000002, 6200.0], "cost": 2.5 + 1e-10, "weights": [1.0, 1.0, 0.25 + 1e-9]},
        {"alternatives": [{"estimate": {"position": [-800.00005, 150.0], "emission": [0.0]}, "gap": 3.2}]},
    ],
)
def test_equal_fixes_have_no_difference(changes):
    assert found(recording(**changes)) == []


def test_a_certificate_that_was_lost_is_gained_in_the_other_direction():
    old = recording(certificate__proof="local")
    assert found(recording(), old) == ["certificate stronger: local -> global"]


def test_alternatives_are_matched_by_position_and_not_by_order():
    both = [rival(-800.0, 150.0), rival(900.0, 900.0)]
    assert found(recording(alternatives=both[::-1]), recording(alternatives=both)) == []


def test_without_tolerance_the_last_bit_is_a_difference():
    new = recording(cost=np.nextafter(2.5, 3.0), estimate__position=[3100.0, np.nextafter(6200.0, 0.0)])
    assert found(new) == []
    assert found(new, tolerance=Tolerance().times(0.0)) == ["estimate moved", "cost higher"]


def test_of_an_iteration_without_convergence_only_words_are_compared():
    old, new = (recording(status="max iterations", cost=cost) for cost in (2.5, 9.0))
    assert found(new, old) == []
    assert found(new, old, Tolerance().times(0.0)) == ["cost higher"]
    assert found(recording(cost=9.0), old) == ["status max iterations -> ambiguous", "cost higher"]
    singular = [recording(status="singular geometry", alternatives=some) for some in ([], [rival(9.0, 9.0)])]
    assert found(*singular) == []
    assert found(*singular, Tolerance().times(0.0)) == ["alternative lost"]


def test_problems_methods_and_fixes_of_one_recording_alone_are_listed():
    def missing(old, new):
        return [(one.group, one.text, one.key) for one in compare(old, new, Tolerance())]

    full, empty, key = recording(), Recording(HEAD, {}, {}), (*KEY[:3], "robust")
    more = Recording(HEAD, full.scenes, full.fixes | {key: FIX})
    assert missing(full, empty) == [("only in the old recording", "tdoa-2d clean seed 0 by all methods", None)]
    assert missing(empty, full) == [("only in the new recording", "tdoa-2d clean seed 0 by all methods", None)]
    assert missing(full, more) == [("only in the new recording", "all problems by robust", None)]
    second = Recording(HEAD, full.scenes | {("toa-2d", "clean", 0): SCENE}, more.fixes)
    third = Recording(HEAD, second.scenes, full.fixes | {("toa-2d", "clean", 0, "robust"): FIX})
    assert missing(second, third)[1] == ("only in the old recording", "", key)


def test_problems_that_differ_are_listed():
    other = Recording(HEAD, {KEY[:3]: SCENE | {"z": [1.5]}}, recording().fixes)
    assert [(one.group, one.text) for one in compare(recording(), other, Tolerance())] == [
        ("the problems differ", "tdoa-2d clean seed 0: z")
    ]


def test_a_line_has_what_explains_a_difference():
    old, new = recording(), recording(estimate__position=[3103.0, 6200.0], cost=1.5)
    text = "\n".join(listing(old, new, compare(old, new, Tolerance())))
    assert "estimate: estimate moved (1)" in text
    assert "tdoa-2d clean seed 0 auto: by -1, 2.5 -> 1.5" in text
    assert "(ambiguous, cost 2.5, 1 sigma from the truth -> ambiguous, cost 1.5, 0 sigma from the truth)" in text
    assert "1 fixes in both: 0 identical, 0 equal, 1 differ" in text


def test_a_recording_is_read_as_it_was_written_and_equals_its_repetition(tmp_path, capsys):
    # IPOPT and the losses take seconds to load; these are the quickest of the methods
    options = ["--cases", "tdoa-2d", "azimuth-2d", "--methods", "gtrs", "wiv", "--variants", "clean", "--seeds", "1"]
    files = [str(tmp_path / name) for name in ("old.jsonl", "new.jsonl")]
    assert [main(["record", file, *options]) for file in files] == [0, 0]
    assert main(["compare", *files, "--tolerance", "0"]) == 0
    assert "4 fixes in both: 4 identical, 4 equal, 0 differ" in capsys.readouterr().out
    first = read(tmp_path / "old.jsonl")
    assert list(first.fixes) == [(c, "clean", 1, m) for c in ("tdoa-2d", "azimuth-2d") for m in ("gtrs", "wiv")]
    assert {fix["status"] for fix in first.fixes.values()} == {"ok", "unavailable"}
    # another tolerance of the same file finds a planted bit, also by the command
    lines = (tmp_path / "new.jsonl").read_text().splitlines()
    fix = next(i for i, line in enumerate(lines) if '"ok"' in line)
    lines[fix] = json.dumps(json.loads(lines[fix]) | {"cost": 99.0})
    (tmp_path / "new.jsonl").write_text("\n".join(lines))
    assert main(["compare", *files]) == 1
    assert main(["compare", *files, "--ignore", "cost"]) == 0
    (tmp_path / "new.jsonl").write_text("\n".join(lines)[:-20])
    assert main(["compare", *files]) == 2


def test_numbers_keep_all_bits_and_absent_ones_have_texts():
    values = np.array([0.1 + 0.2, np.nan, -np.inf])
    assert json.loads(json.dumps(plain({"x": values}), allow_nan=False)) == {"x": [0.1 + 0.2, "nan", "-inf"]}


def test_a_failure_is_a_record(tmp_path):
    def broken(problem, method):
        raise ImportError("no module named nlopt") if method == "absent" else ZeroDivisionError("division by zero")

    assert solved(None, "absent", broken) | {"seconds": 0} == {
        "status": "unavailable",
        "reason": "ImportError: no module named nlopt",
        "seconds": 0,
    }
    assert solved(None, "auto", broken)["error"] == "ZeroDivisionError: division by zero"
    some = record(tmp_path / "one.jsonl", scenes(["tdoa-2d"], ["clean"], [0]), ["no method"], {}, lambda line: None)
    assert some[0]["error"].startswith("InvalidProblem: ")
    assert read(tmp_path / "one.jsonl").fixes.keys() == {("tdoa-2d", "clean", 0, "no method")}


def test_every_stage_that_optloc_ships_is_in_a_method():
    words = {word for text in (*METHODS.values(), *shipped_methods()) for word in text.replace("|", "+").split("+")}
    assert set(own_words()) <= words
    assert not set(REFINEMENTS) & {word for text in METHODS.values() for word in text.replace("|", "+").split("+")}


def test_variants_are_of_one_problem_and_the_same_each_time():
    clean, gross, few = (one.problem for one in scenes(["tdoa-2d"], VARIANTS, [0]))
    assert np.array_equal(clean.observed, CASES["tdoa-2d"].problem.observed)
    assert (clean.observed != gross.observed).sum() == 1
    assert few.weight.sum() == few.layout.size < few.count
    again = [one.problem for one in scenes(["tdoa-2d"], VARIANTS, [0])]
    assert np.array_equal(gross.observed, again[1].observed)
    assert np.array_equal(few.weight, again[2].weight)


def test_kinds_are_listed_in_one_order():
    new = recording(weights=[1.0, 1.0, 0.3], status="ok", cost=9.0)
    kinds = [one.kind for one in compare(recording(), new, Tolerance())]
    assert kinds == sorted(kinds, key=KINDS.index)
    assert kinds[0] == "status"
