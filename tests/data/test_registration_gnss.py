"""Satellite and system offsets of pseudoranges: learnt at a known receiver, and what a receiver can know of them."""

from dataclasses import replace

import numpy as np
import pytest
from data.registration import calibrating, corrected, fixed, learnt, lines, part
from data.windows import report
from often import few

from optloc import Motion, Status, solve, with_bias
from optloc.bounds.rank import observability
from optloc.lab.datasets import gnss

pytestmark = pytest.mark.data

# Median residual by satellite at the true site in the set's README (prc_if, epoch median removed), metres; E09 is left
# out, it stands 5 degrees high and the mask is 10.
README = {
    "K078": {"G01": -1.4, "G04": -0.4, "G06": 0.0, "G14": 0.0, "G17": 0.1, "G19": 1.8, "G22": 2.1, "G28": 5.1,
             "E07": 0.0, "E13": -0.6, "J03": 1.1},
    "N176": {"G05": 0.4, "G13": 1.0, "G20": 2.9, "G24": -1.6, "E04": -1.1, "E12": -0.5, "J07": 0.4},
}  # fmt: skip
WIDE, PRIOR = 20.0, 2.0


@pytest.fixture(params=few(README, 1))
def session(request, data_dir):
    return request.param, gnss.load(data_dir / "gnss_static", request.param, "prc_if_m")


def offsets(session, epochs):
    """Return the offset of each satellite, learnt at the known receiver."""
    problem = with_bias(part(session.run(), epochs), "satellite", sigma=WIDE)
    there = np.broadcast_to(session.truth, (problem.epochs, 3))
    calibrated = calibrating(problem, there)
    return learnt(calibrated, fixed(solve(calibrated)), "satellite")


def test_calibration_finds_the_published_offsets(session):
    name, data = session
    found = offsets(data, np.arange(0, data.run().epochs, 2))
    off = np.array([found[satellite] - median for satellite, median in README[name].items()])
    off -= np.median(off)  # what all share is the clock
    report(f"GNSS {name}: offsets less the README's {off.round(2)} m")
    assert np.abs(off).max() < 0.2


def test_offsets_of_the_first_minutes_help_the_others(session):
    name, data = session
    run = data.run()
    half = run.epochs // 2
    values = offsets(data, np.arange(half))
    later = replace(part(run, np.arange(half, run.epochs, 3)), motions=(Motion(span="epoch"),))
    errors = {
        case: data_error(data, solve(problem))
        for case, problem in (("before", later), ("calibration", corrected(later, values)))
    }
    found = lines(f"GNSS {name}, 3-D", errors)
    assert found["calibration"][0] < 0.6 * found["before"][0]
    assert found["calibration"][1] < 0.8 * found["before"][1]


def data_error(data, fix):
    return np.linalg.norm(fixed(fix).position - data.truth, axis=-1)


def test_satellite_offsets_do_not_show_at_an_unknown_receiver(session):
    name, data = session
    few, many = (part(data.run(), np.arange(0, 75, step)) for step in (15, 3))
    blind = with_bias(many, "satellite")
    fix = solve(blind)
    assert fix.status == Status.SINGULAR_GEOMETRY
    assert "satellite" in str(fix.reason)
    start = np.concatenate([data.truth, np.zeros(blind.layout.size - 3)])
    assert observability(blind, start).open == ("the data do not determine a common change of every satellite",)
    # With one as reference the sky would have to turn: the bound is metres to tens of metres, and the report says why.
    rest = with_bias(many, "satellite", members=blind.biases[0].members[1:])
    seen = observability(rest, start[:-1])
    known = solve(many).sigma()
    report(f"GNSS {name} against a reference: position sigma {seen.posterior[:3]} m, {known} m if offsets are none")
    report("   " + "; ".join(seen.sentences))
    assert seen.tied
    assert seen.posterior[:3].min() > 15.0 * known.max()
    # With a prior four combinations (the position and the clock) stay at it, however long one looks.
    share, sigma = zip(*(posterior(problem) for problem in (few, many)), strict=True)
    report(f"GNSS {name}, prior 2 m: position sigma {sigma[0]} m of {few.epochs} epochs, {sigma[1]} m of {many.epochs}")
    assert min(s[-4:].min() for s in share) > 0.85
    assert share[1][:-4].max() < 0.2
    np.testing.assert_allclose(sigma[1], sigma[0], rtol=0.2)


def posterior(problem):
    """Return the variances of combinations of offsets as shares of their prior, ascending, and the position's sigma."""
    fix = fixed(solve(with_bias(problem, "satellite", sigma=PRIOR)))
    return np.linalg.eigvalsh(fix.covariance("satellite")) / PRIOR**2, fix.sigma()


def test_system_offsets_show_at_an_unknown_receiver(session):
    name, data = session
    run = data.run()
    systems = {s: [n for n in run.stations.names if n[0] == s] for s in "EJ"}
    blind = with_bias(run, "system", members=systems)
    fix = fixed(solve(blind))
    there = fixed(solve(calibrating(blind, np.broadcast_to(data.truth, (run.epochs, 3)))))
    report(f"GNSS {name}, E and J against G: blind {fix.take('system')} m, calibration {there.take('system')} m")
    assert not observability(blind, fix.x).sentences
    assert fix.sigma("system").max() < 0.15
    assert np.abs(fix.take("system") - there.take("system")).max() < 0.7
    assert np.abs(fix.take("system")).max() < 1.5
    plain = np.linalg.norm(fixed(solve(run)).position - data.truth)
    error = np.linalg.norm(fix.position - data.truth)
    report(f"   3-D error {plain:.2f} m without, {error:.2f} m with them")
    assert error < plain
