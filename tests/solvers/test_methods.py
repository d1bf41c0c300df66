"""A method that only starts is refined and judged, or refused with the reason and with a method that works."""

import numpy as np
import pytest
from often import few

import optloc
from optloc import Status, assemble, measured
from optloc.base.frames import geodetic_to_ecef
from optloc.solvers import given
from optloc.solvers.methods import FORMULATIONS, SOLVERS, Choice, Method, using

STATIONS = 1e3 * np.array([[0, 0, 0], [10, 0, 6], [0, 10, 3], [10, 10, 0], [5, 5, 6], [2, 7, 1.0]])
TRUTH = np.array([22e3, 14e3, 3e3])
SIGMA = {"azimuth": 0.01, "elevation": 0.01, "groa": 0.01, "rss_difference": 1.0}
WORDS = ("gtrs", "roots", "sdp", "socp", "sparse", "wiv", "directions", "minimax")
PAIRS = ("tdoa", "range_sum", "groa", "rss_difference")
SATELLITES = geodetic_to_ecef(*np.radians([[24.44, 25.09, 24.44], [125.21, 125.68, 125.99]]), np.full(3, 800e3))
BELOW = geodetic_to_ecef(*np.radians([24.6, 125.6]), 100.0)


def rows_of(kind, count=6):
    sigma = SIGMA.get(kind, 5.0)
    if kind in PAIRS:
        return measured(kind, a=np.arange(1, count), b=np.zeros(count - 1, dtype=int), sigma=sigma)
    return measured(kind, a=np.arange(count), sigma=sigma)


def drawn(template, truth):
    return optloc.simulate(template, np.pad(truth, (0, template.layout.size - len(truth))), seed=1)


def problem_of(name):
    """Return a problem: its dimension, then its kinds, of which a number at the end says how many stations have it."""
    if name.startswith("satellites"):
        rows = measured("toa", a=[0, 1, 2], sigma=15.0)
        if "tdoa" in name:
            rows = measured("tdoa", a=[0, 0], b=[1, 2], sigma=15.0)
        height = optloc.constraints.height(exactly=100.0)
        return drawn(assemble(SATELLITES, rows, frame=optloc.problem.ECEF, constraints=[height]), BELOW)
    dimension, *kinds = name.split()
    d = int(dimension)
    parts = [rows_of(kind.rstrip("1"), 1 if kind.endswith("1") else 6) for kind in kinds]
    return drawn(assemble(STATIONS[:, :d], *parts), TRUTH[:d])


PROBLEMS = [
    "3 azimuth elevation",
    "2 azimuth",
    "2 tdoa",
    "3 elevation",
    "3 azimuth",
    "3 range",
    "satellites tdoa",
    "3 range azimuth elevation",
    "3 range azimuth1 elevation1",
    "3 tdoa",
    "3 toa",
    "3 range_sum",
    "3 groa",
    "3 rss_difference",
    "3 tdoa azimuth",
    "3 toa groa",
    "3 tdoa groa azimuth elevation",
    "3 elevation range",
    "2 range",
    "2 toa",
    "2 range_sum",
    "2 groa",
    "2 rss_difference",
    "2 tdoa azimuth",
    "2 tdoa azimuth1",
    "2 toa groa",
    "satellites toa",
]
# What can be said of an answer that was judged.
JUDGED = (Status.OK, Status.CURVED, Status.UNPROVEN, Status.AMBIGUOUS)


@pytest.mark.parametrize("name", few(PROBLEMS, 5))
def test_every_word_answers_or_says_why_not_and_what_does(name):
    problem = problem_of(name)
    auto = optloc.solve(problem)
    for word in WORDS:
        fix = optloc.solve(problem, word)
        if fix.answered:
            assert fix.status in JUDGED, (word, fix.status)
            assert [stage.name for stage in fix.stages][:3] == [word, "lsr", "certify"]
            if alone := fix.status in (Status.OK, Status.CURVED):
                assert fix.position == pytest.approx(auto.position, abs=1.0), word
            assert alone or name.endswith("rss_difference")
            continue
        reason = str(fix.reason)
        assert "does not apply" not in fix.status.sentence
        if auto.answered:
            # the rows determine a position: the word is the reason, and the method that is named works
            assert fix.status == Status.UNAVAILABLE, (word, fix.status)
            assert "use 'auto'" in reason
        else:
            assert fix.status == Status.SINGULAR_GEOMETRY, (word, fix.status)
            assert reason == "no measurement depends on position z"


@pytest.mark.parametrize("word", WORDS)
def test_bearings_in_space_start_with_every_word(word):
    """What answered that the method does not apply, though it does."""
    problem = problem_of("3 azimuth elevation")
    fix, asked = optloc.solve(problem, word), optloc.solve(problem, f"{word}+lsr+certify")
    assert fix.status == Status.OK
    assert fix.certificate.proof == "global"
    np.testing.assert_allclose(fix.x, asked.x, rtol=0.0, atol=1e-6)
    assert np.isfinite(fix.cov).all()
    raw = optloc.solve(problem, word, refine=False)
    assert raw.status == Status.UNREFINED
    assert f"{raw.status.label}" == "unrefined"
    assert np.linalg.norm(raw.position - fix.position) < 500.0
    assert np.isnan(raw.cov).all()


def test_contradictions_are_judged_too():
    problem = problem_of("3 azimuth elevation")
    z = problem.z.copy()
    z[0] += 1.0
    fix = optloc.solve(problem.with_rows(z=z), "minimax")
    assert fix.status == Status.MISFIT


def test_refusals_name_what_is_missing():
    said = {
        ("3 range", "minimax"): "starts from azimuth and elevation of two stations or more, and these rows are range",
        ("2 tdoa", "directions"): "relaxes directions in three dimensions, and these rows are in a plane",
        ("3 toa groa", "wiv"): "starts from azimuths, and these rows are toa and groa",
        ("3 elevation", "roots"): "no closed form gives a start for measurements of elevation: use 'auto'",
        ("3 range azimuth1 elevation1", "directions"): "of two stations or more",
        ("satellites tdoa", "sparse"): "sparse finds no start from these rows: use 'auto'",
    }
    for (name, word), words in said.items():
        fix = optloc.solve(problem_of(name), word)
        assert words in str(fix.reason), (name, word)
        assert np.isnan(fix.x).all()


@pytest.mark.parametrize("word", ["minimax", "sdp"])
def test_batches_and_runs_of_starts(word):
    problem = problem_of("3 azimuth elevation")
    many = problem.with_rows(z=problem.z + 0.001 * np.random.default_rng(4).standard_normal((5, problem.count)))
    fix = optloc.solve(many, word)
    assert fix.shape == (5,)
    assert (fix.code == Status.OK).all()
    # one row of one problem is no number
    z = many.z.copy()
    z[2, 3] = np.nan
    fix = optloc.solve(many.with_rows(z=z), word)
    assert fix[2].status == Status.REJECTED
    assert (fix.code[[0, 1, 3, 4]] == Status.OK).all()
    none = np.full_like(z, np.nan)
    assert (optloc.solve(many.with_rows(z=none), word, refine=False).code == Status.REJECTED).all()


def test_a_failed_back_end_is_not_taken_for_rows_that_do_not_fit():
    problem = problem_of("3 range")
    with using(Choice("conic", "SCS", {"max_iters": 1})):
        fix = optloc.solve(problem, "sdp")
    assert fix.status == Status.NUMERICAL
    assert str(fix.reason) == "sdp: 2 of 2 solves without an answer (SCS: optimal_inaccurate)"


def test_starts_of_others_stay_starts():
    problem = problem_of("2 tdoa").flat()
    fix = given(problem, TRUTH[None, :2] + 10.0)
    assert (fix.code == Status.UNREFINED).all()
    assert "+lsr+certify" in Status.UNREFINED.sentence
    assert "does not apply" not in Status.UNREFINED.sentence


def test_every_start_of_a_formulation_is_a_word_of_this_table():
    found = {word for form in FORMULATIONS.values() for word in form.starts}
    assert found <= set(WORDS)
    unrefined = {name for name, entry in SOLVERS.items() if entry.role == "start"} - set(optloc.problem.LOSSES)
    assert unrefined == set(WORDS)


def test_the_former_name_of_a_stage_works_with_a_warning():
    with pytest.warns(DeprecationWarning, match="widen is add_candidates now"):
        method = Method.parse("roots+lsr+widen+lsr")
    assert method.words == ("roots", "lsr", "add_candidates", "lsr")
