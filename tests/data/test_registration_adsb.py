"""Clocks of receivers learnt from airliners, whose places are known or not, and applied to messages not learnt from."""

import numpy as np
import pytest
from data.registration import calibrating, corrected, fixed, learnt, lines, not_beaten, part, plausible
from data.windows import report
from often import few

from optloc import solve, with_bias
from optloc.bounds.rank import observability
from optloc.lab.datasets import adsb

pytestmark = pytest.mark.data

# What the set's README finds with all messages: medians at the true place by receiver, metres, and their number.
README = {
    "598": (-8, 574), "147": (-14, 443), "632": (-5, 439), "10": (11, 356), "141": (-21, 347), "263": (-3, 332),
    "143": (20, 289), "257": (47, 184), "124": (0, 135), "149": (10, 108), "299": (6, 87), "402": (-40, 70),
    "568": (32, 70), "564": (9, 70),
}  # fmt: skip
# Receivers are disciplined by GPS; a prior keeps those that heard a handful of messages, and what all share.
PRIOR = 50.0
BUSY = ("598", "147", "632", "141", "263", "10", "143")
ODD, EVEN = np.arange(1, 763, 2), np.arange(0, 763, 2)


@pytest.fixture(scope="module")
def data(data_dir):
    return adsb.load(data_dir / "locards_adsb", refraction=True)


def learn(data, messages, *, blind):
    """Return the problem and the fix of the clocks, from those messages that do not contradict themselves."""
    some = part(data.problem, messages)
    some = some if blind else calibrating(some, data.truth[messages])
    kept = plausible(some)
    problem = with_bias(part(data.problem, messages[kept]), "clock", kind="toa", sigma=PRIOR)
    problem = problem if blind else calibrating(problem, data.truth[messages[kept]])
    return problem, fixed(solve(problem)), messages[kept]


def errors(data, messages, clocks):
    """Return horizontal errors of messages, each fixed alone with clocks taken as known."""
    fix = fixed(solve(corrected(part(data.problem, messages), clocks, kind="toa")))
    return data.horizontal(fix.position, messages)


@pytest.mark.slow
@pytest.mark.parametrize("halves", few([(ODD, EVEN), (EVEN, ODD)], 1), ids=["odd", "even"])
def test_clocks_learnt_on_one_half_help_the_other(data, halves):
    first, second = halves
    clocks = {}
    for name, blind in (("calibration", False), ("blind", True)):
        problem, fix, kept = learn(data, first, blind=blind)
        clocks[name] = learnt(problem, fix, "clock")
        off, rms = against_the_readme(clocks[name])
        report(f"ADS-B {name}: {len(kept)} of {len(first)} messages, p = {fix.p_value:.2g}; README's less ours {off} m")
        assert rms < {"calibration": 10.0, "blind": 20.0}[name]
    seconds = {name: errors(data, second, values) for name, values in clocks.items()}
    found = lines("ADS-B", {"before": errors(data, second, {}), **seconds})
    for name in clocks:
        assert found[name][0] <= (50.0 if second is EVEN else 55.0)
        assert found[name][1] <= (285.0 if second is EVEN else 310.0)
        assert found[name][0] < found["before"][0]
        assert found[name][1] < found["before"][1]


def against_the_readme(clocks):
    """Return the README's biases less ours, and their rms, both weighed by messages and without what all share."""
    weight = np.array([count for _, count in README.values()])
    off = np.array([bias - clocks[name] for name, (bias, _) in README.items()])
    off -= np.average(off, weights=weight)
    return dict(zip(README, off.round().astype(int).tolist(), strict=True)), np.sqrt(np.average(off**2, weights=weight))


def test_the_blind_start_needs_no_guess(data):
    problem, fix, kept = learn(data, ODD[:100], blind=True)
    truth = np.zeros(problem.layout.size)
    local = problem.layout.split(truth)[1]
    local[:, : data.truth.shape[1]] = data.truth[kept]
    not_beaten(problem, fix, truth)


def test_what_all_clocks_share_is_the_emission_time(data):
    # Without a prior nothing tells a common offset from later emissions: the answer says so instead of guessing.
    messages = heard_by_the_busy(data)
    whole, rest = (
        calibrating(with_bias(part(data.problem, messages), "clock", kind="toa", members=names), data.truth[messages])
        for names in (BUSY, BUSY[1:])
    )
    seen = observability(whole, np.zeros(whole.layout.size))
    report(f"ADS-B, {len(BUSY)} clocks without a prior: {'; '.join(seen.sentences)}")
    assert seen.open == ("the data do not determine a common change of every clock",)
    assert not solve(whole).answered
    assert fixed(solve(rest)).sigma("clock").max() < 20.0


def heard_by_the_busy(data):
    """Return the messages that only receivers of `BUSY` heard."""
    rows = data.problem.rows[0]
    others = rows.epoch[~np.isin(np.array(data.problem.stations.names)[rows.a], BUSY)]
    return np.setdiff1d(np.arange(data.problem.epochs), others)
