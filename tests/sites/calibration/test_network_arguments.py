"""Arguments of networks: wrong values are refused with a sentence."""

import numpy as np
import pytest
from sites.calibration.scenes import hall

from optloc import InvalidProblem
from optloc.sites.calibration import network_of


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"kind": "azimuth"}, "networks have no rows of kind 'azimuth'"),
        ({"pairs": [(0, 1)]}, "the argument pairs and the kind tdoa need each other"),
        ({"dimension": 4}, "a network has 4 dimensions"),
        ({"names": ["a", "b", "a", "c", "d"]}, "station name 'a' is used twice"),
        ({"sigma": 0.0}, "a standard deviation is not positive"),
        ({"place": np.zeros((4, 3))}, r"places have shape \(4, 3\)"),
        ({"distances": [(0, 5, 1.0, 0.1)]}, "a distance has an unknown station"),
        ({"distances": [(0, 1, 1.0, 0.0)]}, "a distance has no positive standard deviation"),
    ],
)
def test_what_cannot_be_is_one_sentence(arguments, said):
    _, z = hall(1, 5, 4, 0.0)
    with pytest.raises(InvalidProblem, match=said):
        network_of(**({"z": z, "sigma": 0.1} | arguments))


def test_places_of_another_dimension_are_refused():
    _, z = hall(1, 5, 7, 0.0)
    with pytest.raises(InvalidProblem, match=r"places of shape \(5, 3\) for 5 stations in 2 dimensions"):
        network_of(z, 0.1, dimension=2, place=np.zeros((5, 3)))
    assert network_of(z, 0.1, place=np.zeros((5, 2))).dimension == 2
