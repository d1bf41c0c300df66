"""Malformed input to the Python API is refused with one sentence that names the culprit and says what to do."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, STATIONS, stations

from optloc import Frame, InvalidProblem, Motion, Stations, assemble, crlb, measured, solve, station_array
from optloc.problem import ECEF, Bias, Prior
from optloc.problem.layout import Layout

SIX = np.arange(6)
ENU = Frame.enu(lat_deg=47.0, lon_deg=8.0)


def ranges(**changes):
    given = {"z": np.full(6, 5e3), "a": SIX, "sigma": 1.0} | changes
    return measured("range", given.pop("z"), **given)


def problem_of(*, rows=None, place=STATIONS[2], **more):
    return assemble(place, rows if rows is not None else ranges(), **more)


def biased(**changes):
    given = {
        "name": "clock",
        "members": ("A", "B"),
        "row": [0, 1],
        "member": [0, 1],
        "coefficient": [1.0, 1.0],
    } | changes
    for key in ("row", "member", "coefficient"):
        given[key] = np.array(given[key])
    return problem_of(biases=(Bias(**given),))


def covariance(change):
    full = np.eye(6)
    change(full)
    return problem_of(rows=ranges(sigma=None, covariance=full))


def put(index, value):
    def change(array):
        array[index] = value

    return change


def angles(d=2, **more):
    return measured("azimuth", np.zeros(6), a=SIX, sigma=0.01, **more)


skew = np.array([[1.0, 0.0], [0.5, 1.0]])

# What is wrong, how it is built, and what the sentence must name.
TABLE = {
    "unknown kind": (lambda: measured("tdao", [1.0], a=0, b=1, sigma=1.0), "'tdao'.*tdoa"),
    "no noise": (lambda: measured("range", [1.0], a=0), "noise of range"),
    "two noises": (lambda: measured("range", [1.0], a=0, sigma=1.0, covariance=[[1.0]]), "noise of range"),
    "no station": (lambda: measured("tdoa", [1.0], a=0, sigma=1.0), "tdoa needs station b"),
    "unequal lengths": (lambda: measured("range", [1.0, 2.0, 3.0], a=[0, 1], sigma=1.0), r"range.*\[2, 3\] rows"),
    "weights of another length": (lambda: ranges(weight=[1.0, 1.0]), "range.*2.*6"),
    "corrections of another length": (lambda: ranges(correction=[1.0, 1.0]), "range.*2.*6"),
    "half a station": (lambda: ranges(a=[0, 1, 2, 3, 4, 4.5]), "a.*4.5.*whole"),
    "words for numbers": (lambda: ranges(z=["far"] * 6), "z.*'far'|far"),
    "ragged numbers": (lambda: ranges(z=[[1.0], [1.0, 2.0]]), "z"),
    "station beyond": (lambda: problem_of(rows=ranges(a=SIX + 1)), "range row 5 has a = 6.*0 to 5"),
    "station below": (lambda: problem_of(rows=ranges(a=SIX - 1)), "range row 0 has a = -1"),
    "second station beyond": (
        lambda: problem_of(rows=measured("tdoa", [1.0], a=0, b=9, sigma=1.0)),
        "tdoa row 0 has b = 9",
    ),
    "one station twice": (
        lambda: problem_of(rows=measured("tdoa", [1.0], a=2, b=2, sigma=1.0)),
        "tdoa row 0.*one station twice",
    ),
    "epoch below": (lambda: problem_of(rows=ranges(epoch=-1)), "epoch = -1"),
    "epoch beyond": (lambda: problem_of(rows=ranges(epoch=4), times=[0.0, 1.0]), "epoch = 4.*0 to 1"),
    "target beyond": (lambda: problem_of(rows=ranges(target=1)), "target = 1"),
    "no rows": (
        lambda: problem_of(rows=measured("range", np.zeros(0), a=np.zeros(0, int), sigma=1.0)),
        "no measurements|no rows",
    ),
    "nothing measured": (lambda: assemble(STATIONS[2]), "no measurements"),
    "infinite value": (
        lambda: problem_of(rows=ranges(z=np.r_[np.full(5, 1.0), np.inf])),
        "range row 5.*infinite.*remove",
    ),
    "infinite correction": (lambda: problem_of(rows=ranges(correction=np.inf)), "range.*correction"),
    "nan correction": (lambda: problem_of(rows=ranges(correction=np.nan)), "range.*correction"),
    "weight above one": (lambda: problem_of(rows=ranges(weight=1.5)), "weight outside 0 to 1"),
    "negative weight": (lambda: problem_of(rows=ranges(weight=-0.5)), "weight outside 0 to 1"),
    "nan weight": (lambda: problem_of(rows=ranges(weight=np.nan)), "weight outside 0 to 1"),
    "zero sigma": (lambda: problem_of(rows=ranges(sigma=0.0)), "sigma.*range row 0.*positive"),
    "negative sigma": (
        lambda: problem_of(rows=ranges(sigma=[1, 1, -2.0, 1, 1, 1])),
        "sigma.*range row 2.*-2.*positive",
    ),
    "nan sigma": (lambda: problem_of(rows=ranges(sigma=np.nan)), "sigma.*range row 0.*positive"),
    "infinite sigma": (lambda: problem_of(rows=ranges(sigma=np.inf)), "sigma.*range row 0.*positive"),
    "negative arrival sigma": (
        lambda: problem_of(rows=measured("tdoa", [1.0], a=1, b=0, arrival_sigma=-1.0)),
        "arrival_sigma.*-1.*positive",
    ),
    "arrival sigmas of too few": (
        lambda: problem_of(rows=measured("tdoa", [1.0], a=1, b=0, arrival_sigma=[1.0, 2.0])),
        "arrival_sigma.*2.*6 stations",
    ),
    "arrival sigma of angles": (
        lambda: problem_of(rows=measured("azimuth", [1.0], a=1, arrival_sigma=1.0)),
        "azimuth is not a sum",
    ),
    "negative variance": (lambda: covariance(put((3, 3), -1.0)), "row.*3|noise.*not positive"),
    "non-symmetric covariance": (lambda: covariance(put((0, 1), 0.5)), "noise.*not symmetric"),
    "indefinite covariance": (lambda: covariance(put(([0, 1], [1, 0]), 2.0)), "noise.*not positive semidefinite"),
    "nan covariance": (lambda: covariance(put((2, 2), np.nan)), "noise.*not finite"),
    "covariance of another size": (
        lambda: problem_of(rows=ranges(sigma=None, covariance=np.ones((6, 5)))),
        r"range.*covariance.*\(6, 5\)|covariance.*range.*\(6, 5\)",
    ),
    "variances for a covariance": (
        lambda: problem_of(rows=ranges(sigma=None, covariance=np.ones(6))),
        r"covariance.*\(6,\)",
    ),
    "joint covariance of another size": (lambda: problem_of(covariance=np.eye(5)), r"covariance.*\(5, 5\).*6"),
    "flat stations": (lambda: problem_of(place=np.zeros(6)), r"stations.*\(6,\)"),
    "stations in four dimensions": (lambda: problem_of(place=np.zeros((6, 4))), r"stations.*\(6, 4\)"),
    "ragged stations": (lambda: problem_of(place=[[0.0, 1.0], [2.0]]), "stations"),
    "stations in words": (lambda: problem_of(place=[["here", "there"]]), "stations"),
    "nan station": (lambda: problem_of(place=np.r_[STATIONS[2][:5], [[np.nan, 0.0]]]), "'S5' is not finite"),
    "infinite station": (lambda: problem_of(place=np.r_[[[np.inf, 0.0]], STATIONS[2][1:]]), "'S0' is not finite"),
    "name twice": (
        lambda: problem_of(place=station_array(STATIONS[2], ["a", "b", "c", "a", "e", "f"])),
        "'a' is used twice",
    ),
    "names missing": (lambda: problem_of(place=station_array(STATIONS[2], ["a", "b"])), "6 stations have 2 names"),
    "velocities of another shape": (
        lambda: problem_of(place=stations(2, velocity=np.zeros((1, 5, 2)))),
        r"velocity.*\(1, 5, 2\)",
    ),
    "nan velocity": (
        lambda: problem_of(place=stations(2, velocity=np.full((1, 6, 2), np.nan))),
        "velocity.*'S0'.*not finite",
    ),
    "axes of another shape": (
        lambda: problem_of(rows=angles(), place=stations(2, axes=np.zeros((1, 6, 3, 3)))),
        r"axes.*\(1, 6, 3, 3\)",
    ),
    "skewed axes": (
        lambda: problem_of(rows=angles(), place=stations(2, axes=np.tile(skew, (1, 6, 1, 1)))),
        "axes of station 'S0'.*orthogonal|'S0'.*right angles",
    ),
    "station errors of another shape": (
        lambda: problem_of(place=stations(2, covariance=np.eye(2))),
        r"covariance.*\(2, 2\)",
    ),
    "negative station errors": (
        lambda: problem_of(place=stations(2, covariance=-np.tile(np.eye(2), (6, 1, 1)))),
        "position error of station S0.*not positive",
    ),
    "station errors of an unknown span": (
        lambda: problem_of(place=stations(2, covariance=np.tile(np.eye(2), (6, 1, 1)), span="day")),
        "span.*'day'.*epoch.*run",
    ),
    "stations of too few epochs": (
        lambda: problem_of(place=np.stack([STATIONS[2]] * 2), rows=ranges(epoch=[0, 0, 1, 1, 2, 2])),
        "stations.*2.*3 epochs",
    ),
    "elevation in the plane": (
        lambda: problem_of(rows=measured("elevation", [0.1], a=0, sigma=0.1)),
        "elevation has no meaning in 2 dim",
    ),
    "height without a globe": (
        lambda: problem_of(place=STATIONS[3], rows=measured("height", [0.1], sigma=0.1)),
        "height needs a geodetic frame",
    ),
    "height in the plane": (
        lambda: problem_of(rows=measured("height", [0.1], sigma=0.1), frame=ENU),
        "height has no meaning in 2",
    ),
    "flat ECEF": (lambda: problem_of(frame=ECEF), "ECEF need three"),
    "a word for a frame": (lambda: problem_of(frame="ecef"), "frame.*'ecef'"),
    "latitude": (lambda: Frame.enu(lat_deg=95.0, lon_deg=0.0), "latitude 95"),
    "times of another length": (
        lambda: problem_of(times=[0.0, 1.0], rows=ranges(epoch=[0, 0, 0, 1, 1, 2])),
        "epoch = 2|2 times",
    ),
    "times backwards": (lambda: problem_of(times=[0.0, 2.0, 1.0]), "epoch 2 is not later"),
    "nan time": (lambda: problem_of(times=[0.0, np.nan]), "times.*finite"),
    "times in words": (lambda: problem_of(times=["noon"]), "times"),
    "batches of 3 and 4": (lambda: problem_of(rows=ranges(z=np.zeros((3, 6)), sigma=np.ones((4, 6)))), "leading axes"),
    "no motion": (lambda: problem_of(motions=()), "target = 0|motions"),
    "third derivative": (lambda: problem_of(motions=(Motion(3),)), "motions?.*order 3.*0, 1 or 2"),
    "motion of an unknown span": (lambda: problem_of(motions=(Motion(0, span="hour"),)), "'hour'.*run.*epoch"),
    "known path of another dimension": (
        lambda: problem_of(motions=(Motion(0, known=np.zeros((1, 1, 3))),)),
        r"known.*\(1, 1, 3\)",
    ),
    "known path of other epochs": (
        lambda: problem_of(motions=(Motion(0, known=np.zeros((4, 1, 2))),)),
        r"known.*4.*1 epoch",
    ),
    "unknown known path": (lambda: problem_of(motions=(Motion(0, known=np.full((1, 1, 2), np.nan)),)), "known.*finite"),
    "bias of an unknown form": (lambda: biased(form="wobble"), "clock.*'wobble'.*offset"),
    "bias on a row beyond": (lambda: biased(row=[0, 6]), "clock.*row.*6"),
    "bias of a member beyond": (lambda: biased(member=[0, 2]), "clock.*member.*2"),
    "bias of unequal lengths": (lambda: biased(member=[0]), "clock.*(2.*1|length)"),
    "bias with a nan": (lambda: biased(coefficient=[1.0, np.nan]), "clock.*coefficient.*finite"),
    "bias called position": (lambda: biased(name="position"), "'position'.*(taken|twice)"),
    "bias twice": (lambda: problem_of(biases=biased().biases * 2), "'clock'.*(taken|twice)"),
    "bias prior of the wrong size": (lambda: biased(mean=np.zeros(3), sigma=np.ones(3)), "clock.*sigma.*3.*2"),
    "bias prior of no width": (lambda: biased(mean=np.zeros(2), sigma=np.zeros(2)), "clock.*sigma.*positive"),
    "turned ranges": (lambda: biased(form="rotation"), "clock.*rotation.*range"),
    "prior on nothing": (lambda: problem_of(priors=(Prior("speed", np.zeros(2), np.eye(2)),)), "'speed'.*position"),
    "prior of the wrong size": (
        lambda: problem_of(priors=(Prior("position", np.zeros(3), np.eye(3)),)),
        "prior.*position.*3.*2",
    ),
    "prior without covariance": (
        lambda: problem_of(priors=(Prior("position", np.zeros(2), np.zeros((2, 2))),)),
        "prior on position.*not positive",
    ),
    "prior at nan": (
        lambda: problem_of(priors=(Prior("position", np.array([0.0, np.nan]), np.eye(2)),)),
        "prior on position.*not finite",
    ),
    "unlabelled rows": (lambda: solve(problem_of(rows=ranges(target=-1))), "range row 0.*target"),
    "unknown method": (lambda: solve(problem_of(), "sdpp+lsr"), "method.*'sdpp'.*sdp"),
    "empty method": (lambda: solve(problem_of(), ""), "method"),
    "refinement without a start": (lambda: solve(problem_of(), "lsr"), "lsr.*start"),
    "start of another length": (lambda: solve(problem_of(), "lsr", start=np.zeros(3)), r"start.*\(3,\).*2"),
    "unknown unknown": (lambda: solve(problem_of()).take("speed"), "'speed'.*position"),
    "truth of another length": (lambda: crlb(problem_of(), np.zeros(3)), r"vector.*\(3,\).*2 unknowns"),
}


@pytest.mark.parametrize("name", TABLE)
def test_one_sentence_names_the_culprit_and_the_way_out(name):
    build, culprit = TABLE[name]
    with pytest.raises(InvalidProblem, match=culprit) as caught:
        build()
    sentence = str(caught.value)
    assert caught.value.what
    assert caught.value.advice, "the sentence must say what to do"
    assert "\n" not in sentence
    assert sentence.endswith((".", "?"))
    assert len(sentence) < 250


def test_the_table_starts_from_something_valid():
    assert problem_of().count == 6
    assert isinstance(biased().layout, Layout)
    assert covariance(lambda full: None).count == 6
    assert problem_of(rows=angles(), place=stations(2, axes=np.tile(np.eye(2), (1, 6, 1, 1)))).count == 6
    assert solve(problem_of(), "lsr", start=np.full(2, 10.0)).x.shape == (2,)


def test_nan_measurements_are_a_result_not_an_error():
    z = np.full(6, 5e3)
    z[2] = np.nan
    assert problem_of(rows=ranges(z=z)).count == 6


def test_every_case_passes_the_checks_again():
    from optloc.problem.validation import checked

    for case in CASES.values():
        assert checked(case.problem) is case.problem


def test_a_problem_put_together_by_hand_can_be_checked():
    from optloc.problem.validation import checked

    good = problem_of()
    wrong = replace(good, stations=Stations(good.stations.position, ("a",)))
    with pytest.raises(InvalidProblem):
        checked(wrong)
