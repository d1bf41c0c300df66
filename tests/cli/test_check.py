"""The summary of a file: its counts, the redundancy of its epochs, and the extent of its stations."""

import numpy as np
import pytest

from optloc.cli.check import summary
from optloc.cli.options import shipped_problems
from optloc.files import read


@pytest.mark.parametrize("name", ["demo", "ambiguous"])
def test_a_single_epoch_has_its_rows_less_its_unknowns_as_redundancy(name):
    loaded = read(shipped_problems()[name])
    problem, found = loaded.problem, summary(loaded)
    assert (found["epochs"], found["stations"]) == (1, problem.stations.count)
    assert sum(found["rows"].values()) == problem.count
    assert found["redundancy"] == dict.fromkeys(("least", "median"), problem.count - found["unknowns"])
    assert found["groups_of_connected_stations"] == {"most": 1}


def test_the_extent_of_stations_is_that_of_their_principal_axes():
    loaded = read(shipped_problems()["ambiguous"])
    position = loaded.problem.stations.position[0]
    axes = np.sqrt(np.linalg.eigvalsh(np.cov(position.T, bias=True)))
    assert f"{axes[0]:.4g} m" in summary(loaded)["geometry"]
    assert f"{axes[-1]:.4g} m along" in summary(loaded)["geometry"]
