"""The scale of radio ranges, learnt while a mower's places are known or not, and applied to windows not learnt from."""

import numpy as np
import pytest
from data.registration import calibrating, corrected, fixed, learnt, lines, not_beaten, part
from data.windows import report

from optloc import Status, solve, with_bias
from optloc.bounds.rank import observability
from optloc.lab.datasets import plaza
from optloc.problem import by_epoch

pytestmark = pytest.mark.data

# Scale of the affine fit of each beacon in the set's README: ranges are 7 % too long, with no offset.
README = {"S0": 0.068, "S1": 0.071, "S2": 0.068, "S3": 0.070}
HALVES = {
    "odd": (np.arange(1, 155, 2), np.arange(0, 155, 2)),
    "even": (np.arange(0, 155, 2), np.arange(1, 155, 2)),
    "early": (np.arange(78), np.arange(78, 155)),
    "late": (np.arange(78, 155), np.arange(78)),
}


@pytest.fixture(scope="module")
def data(data_dir):
    return plaza.load(data_dir / "plaza_range", "scaled")


def errors(data, windows, values, per):
    fix = fixed(solve(corrected(part(data.problem, windows), values, per=per, form="scale")))
    return np.linalg.norm(fix.position - data.truth[windows], axis=-1)


@pytest.mark.parametrize("per", ["kind", "station"], ids=["common", "by-beacon"])
@pytest.mark.parametrize("half", HALVES)
def test_the_scale_learnt_on_one_half_helps_the_other(data, half, per):
    first, second = HALVES[half]
    blind = with_bias(part(data.problem, first), "scale", per=per, form="scale")
    fix = fixed(solve(blind))
    known = fixed(solve(calibrating(blind, data.truth[first])))
    report(
        f"Plaza {half} by {per}: calibration {known.take('scale')}, blind {fix.take('scale')} +- {fix.sigma('scale')}"
    )
    expected = np.array(list(README.values())) if per == "station" else np.mean(list(README.values()))
    np.testing.assert_allclose(known.take("scale"), expected, atol=0.005)
    off = (fix.take("scale") - known.take("scale")) / fix.sigma("scale")
    assert np.abs(off).max() < 5.0
    found = lines(
        f"Plaza {half} by {per}",
        {"before": errors(data, second, {}, per)}
        | {
            case: errors(data, second, learnt(blind, f, "scale"), per)
            for case, f in (("calibration", known), ("blind", fix))
        },
    )
    assert found["before"][0] > 4.0
    assert found["calibration"][0] <= 0.4
    # Four scales at once cost a blind run part of its accuracy: they are three to four times less certain then.
    assert found["blind"][0] <= (0.4 if per == "kind" else 0.5)


def test_the_blind_run_needs_no_guess_and_tells_what_it_sees(data):
    first, _ = HALVES["odd"]
    problem = with_bias(part(data.problem, first), "scale", per="station", form="scale")
    fix = fixed(solve(problem))
    truth = np.concatenate([np.full(4, 0.07), data.truth[first].ravel()])
    not_beaten(problem, fix, truth)
    seen = observability(problem, fix.x)
    assert not seen.sentences
    np.testing.assert_allclose(seen.posterior, fix.sigma("scale"), rtol=1e-6)


def test_one_window_cannot_tell_scale_from_place(data):
    # Three beacons, three unknowns besides the scale of each: the chi-square has nothing left, and the answer says so.
    window = part(data.problem, HALVES["odd"][0][:1])
    problem = with_bias(by_epoch(window), "scale", per="station", form="scale")
    fix = solve(problem)
    report(f"Plaza, one window: {Status(int(fix.code.ravel()[0])).label}: {fix.reason.ravel()[0]}")
    assert not fix.answered.any()
