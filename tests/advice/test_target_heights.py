"""Ranges to a target above the plane are slant ranges; a wrong exact height of all epochs is one error."""

import re

import numpy as np
from advice.cases import PLACES, TRUTHS, range_case

import optloc
from optloc.advice.causes import causes_of

FLAT = np.linalg.norm(TRUTHS[:2, None] - PLACES, axis=-1)
UP = np.array([0.0, 2.0, 0.3, 1.5, 0.1, 0.7, 1.2]) * 1e3


def test_slant_ranges_need_a_height():
    first = causes_of(range_case(np.hypot(FLAT, 2500.0) - FLAT, epochs=2)[0])[0]
    assert first.change.cause == "height"


def test_a_wrong_exact_height_of_several_epochs_is_one_error_with_its_size():
    stations = np.concatenate([PLACES, UP[:, None]], axis=1)
    truth = np.concatenate([TRUTHS, np.full((4, 1), 5e3)], axis=1)
    rows = optloc.measured("range", a=np.tile(np.arange(7), 4), epoch=np.repeat(np.arange(4), 7), sigma=20.0)
    known = optloc.constraints.box([-np.inf, -np.inf, 4.9e3], [np.inf, np.inf, 4.9e3])
    template = optloc.assemble(stations, rows, motions=(optloc.Motion(span="epoch"),), constraints=known)
    problem = optloc.simulate(template, truth.ravel(), 3)
    (advice,) = [one for one in optloc.advice.advise(problem) if one.cause not in ("redundancy", "mirror")]
    assert advice.cause == "height"
    value, sigma = map(float, re.search(r"of ([\d.]+) ± ([\d.]+) m", advice.seen).groups())
    assert abs(value - 5e3) < 4.0 * sigma < 100.0
