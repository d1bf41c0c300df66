"""The table of formulations: every entry has its file, starts what it serves, and says what it needs."""

from importlib.util import find_spec

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import assemble, measured
from optloc.solvers.formulations import FORMULATIONS


@pytest.mark.parametrize("name", list(FORMULATIONS))
def test_every_formulation_is_a_file_with_words_about_it(name):
    form = FORMULATIONS[name]
    assert find_spec(f"formulations.{name.partition(':')[0]}")
    assert all((form.summary, form.kinds, form.tight, form.cost, form.source))


@pytest.mark.parametrize("word", ["gtrs", "roots"])
def test_squared_ranges_start_at_the_target_of_exact_data(word):
    problem, form = ranges_to(PLACE, 1.0), FORMULATIONS["squared_range"]
    assert form.serves(problem)
    places = form.starts[word](problem)[0]
    assert np.nanmin(np.linalg.norm(places - PLACE, axis=-1)) < 1e-6


def test_bearings_start_by_instruments_and_ranges_need_azimuths():
    azimuth = np.arctan2(*(PLACE - SQUARE).T[::-1])
    problem = assemble(SQUARE, measured("azimuth", azimuth, a=np.arange(5), sigma=0.01)).flat()
    form = FORMULATIONS["bearing_ls"]
    np.testing.assert_allclose(form.starts["wiv"](problem)[0, 0], PLACE, atol=1e-6)
    assert form.needs(problem) == ""
    assert np.isnan(form.starts["wiv"](ranges_to(PLACE, 1.0))).all()
    assert form.needs(ranges_to(PLACE, 1.0)) == "starts from azimuths, and these rows are range"


def test_directions_need_space_and_two_stations():
    form = FORMULATIONS["direction_sdp"]
    assert "in a plane" in form.needs(ranges_to(PLACE, 1.0))
    space = np.column_stack([SQUARE, np.zeros(5)])
    rows = [measured(kind, [0.1], a=[0], sigma=0.01) for kind in ("azimuth", "elevation")]
    assert "two stations or more" in form.needs(assemble(space, *rows).flat())
