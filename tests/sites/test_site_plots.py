"""Placements and calibrations in one axes."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

import optloc
from optloc.sites.calibration import network_of
from optloc.sites.placement import SiteSelection
from optloc.sites.site_plots import PLOTS


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


def test_a_placement_shows_names_candidates_and_losses():
    rng = np.random.default_rng(3)
    masts = rng.uniform(-3e3, 3e3, (7, 2))
    problem = optloc.assemble(masts, optloc.measured("range", a=np.arange(7), sigma=3.0))
    found = optloc.place(SiteSelection(problem, rng.uniform(-2e3, 2e3, (3, 2)), choose=4))
    axes = found.plot()
    assert {"places of interest", "candidate, not taken", "taken"} == set(axes.get_legend_handles_labels()[1])
    texts = {text.get_text() for text in axes.texts}
    assert {f"{one.name}\nlost: {np.sqrt(one.value):.3g} m" for one in found.swaps} <= texts
    assert axes.figure.axes[1].get_ylabel().endswith("(darker: larger error)")
    with pytest.raises(optloc.InvalidProblem, match="no selection"):
        PLOTS["Placement"](type(found)(**{n: getattr(found, n) for n in found.__slots__} | {"selection": None}))


def test_a_calibration_shows_its_network():
    rng = np.random.default_rng(2)
    stations, pulses = rng.uniform(0.0, 50.0, (4, 2)), rng.uniform(0.0, 50.0, (12, 2))
    distances = np.linalg.norm(pulses[:, None] - stations, axis=-1) + 0.01 * rng.standard_normal((12, 4))
    found = optloc.calibrate(network_of(distances, 0.01, kind="range", dimension=2))
    axes = found.plot()
    assert {"pulses", "stations, 95 %"} <= set(axes.get_legend_handles_labels()[1])
    assert axes.get_xlabel() == "x (m)"
    with pytest.raises(optloc.InvalidProblem, match="no view"):
        found.plot(view=(0, 2))
