"""Short forms of networks, calibrations and placements: at most 15 lines and 1 000 characters."""

from functools import cache

import numpy as np
import pytest
from sites.calibration.scenes import hall as network_hall
from sites.placement.scenes import hall as site_hall

from optloc import calibrate, place
from optloc.sites.calibration import network_of, pose_network
from optloc.sites.placement import SiteSelection, pose_placement
from optloc.sites.site_forms import FORMS


def network():
    """Return a network of 8 stations and 30 pulses."""
    return network_of(network_hall(3, 8, 30, 0.03)[1], 0.03)


def selection():
    """Return a choice of 4 of 7 sites for three places."""
    problem, places = site_hall(n=7, places=3)
    return SiteSelection(problem, places, choose=4, gap=1e-6)


MAKERS = {
    "network": network,
    "calibration": lambda: calibrate(network()),
    "placement": lambda: place(selection()),
    "posed placement": lambda: pose_placement(selection()),
    # As few pulses as the program allows: posing 30 pulses takes a minute.
    "posed network": lambda: pose_network(network().take(np.arange(10))),
}


@cache
def value(name):
    return MAKERS[name]()


@pytest.mark.parametrize("name", MAKERS)
def test_a_short_form_is_short(name):
    text = repr(value(name))
    assert text.count("\n") < 15
    assert len(text) <= 1000
    assert "next" in text.splitlines()[-1]
    assert "object at" not in text
    assert value(name)._repr_html_().startswith("<table")


def test_the_main_numbers_are_in_it():
    assert repr(value("network")).startswith("Network: 8 stations, 30 pulses, 3 dimensions")
    calibration = value("calibration")
    assert calibration.status.label in repr(calibration).splitlines()[1]
    assert f"p = {calibration.p_value:.3g}" in repr(calibration)
    placement = value("placement")
    assert f"{placement.sigma:.4g} m" in repr(placement)
    assert all(name in repr(placement) for name in placement.chosen)


def test_every_entry_is_tested():
    assert {type(value(name)).__name__ for name in MAKERS} == FORMS.keys()
