"""Unknowns of a problem file: motions, and priors in any unit."""

import numpy as np
import pytest

from optloc import InvalidProblem, Motion
from optloc.files.row_epochs import Epochs
from optloc.files.schema import PriorTable, validate
from optloc.files.unknowns import motions_of, needs_clock, prior_of

REST = {"format": 2, "stations": {"file": "s.csv"}, "measurements": [{"kind": "range", "file": "r.csv"}]}


def epochs(count, targets=("target",)):
    none = np.zeros(count, dtype=int)
    return Epochs(np.arange(count), none, tuple(map(str, range(count))), np.arange(float(count)), targets)


def test_targets_rest_in_one_epoch_and_are_free_in_several():
    file = validate(REST, "x.toml")
    assert motions_of(file, epochs(1), {}, "x") == (Motion(0, "run"),)
    assert motions_of(file, epochs(2), {}, "x") == (Motion(0, "epoch"),)


def test_each_target_has_its_motion_and_only_a_moving_one_needs_a_clock():
    file = validate(
        REST | {"targets": {"b": {"motion": "constant_velocity"}}, "target": {"motion": "static"}}, "x.toml"
    )
    found = motions_of(file, epochs(3, ("a", "b")), {}, "x")
    assert [motion.order for motion in found] == [0, 1]
    assert needs_clock(found, []) == "a moving target"
    assert needs_clock(found[:1], []) is None
    with pytest.raises(InvalidProblem, match="no row has the target 'b'"):
        motions_of(file, epochs(3), {}, "x")


def test_a_prior_is_in_si_units():
    found = prior_of(PriorTable(name="position", mean=[1.0, 2.0], sigma="30 m", unit="km"), 2, "x")
    assert found.mean.tolist() == [1000.0, 2000.0]
    assert found.covariance == pytest.approx(900.0 * np.eye(2))
    with pytest.raises(InvalidProblem, match="1 coordinates, not 2"):
        prior_of(PriorTable(name="position", mean=[1.0], sigma="30 m"), 2, "x")
