"""Short forms of the values of the core: at most 15 lines and 1 000 characters, with the numbers that matter."""

from functools import cache

import numpy as np
import pytest
from multi_target.scenes import drawn
from show.ranging import ENU, PLACES, ranged

import optloc
from optloc import Motion
from optloc.base.short_form import ShortForm, short_form_of
from optloc.multi_target import separate
from optloc.show import Sheet, TextTable
from optloc.show.short_forms import FORMS, html_of_form, listed, status_counts, text_of_form
from optloc.tracking import State, followed, polynomial
from optloc.uncertainty import likelihood_region

LINES, CHARACTERS = 15, 1000


def run():
    """Return a run of 40 scans of a moving target."""
    a, epoch = np.tile(np.arange(4), 40), np.repeat(np.arange(40), 4)
    rows = optloc.measured("range", a=a, epoch=epoch, sigma=2.0)
    made = optloc.assemble(PLACES, rows, times=np.arange(40.0), motions=(Motion(1),), frame=ENU)
    return optloc.simulate(made, np.array([300.0, 400.0, 5.0, -2.0]), 1)


def track():
    """Return the track of the run from a given state."""
    start = State(-1.0, np.array([290.0, 410.0, 5.0, -2.0]), np.diag([100.0, 100.0, 4.0, 4.0]))
    return followed(run(), start, polynomial(1))


def emitters():
    """Return the emitters of a scene."""
    scene = drawn(1, 1, false=0)
    return separate(scene.problem, scene.clutter)[0]


MAKERS = {
    "problem": lambda: ranged()[0],
    "batch of problems": lambda: optloc.simulate(ranged()[0], ranged()[1].position, 1, trials=100),
    "run": run,
    "track": track,
    "region": lambda: likelihood_region(*ranged()),
    "posed program": lambda: optloc.pose(ranged()[0], "nls"),
    "posed relaxation": lambda: optloc.pose(ranged()[0], "squared_range_conic: hull"),
    "prepared": lambda: optloc.prepare(ranged()[0]),
    "emitters": emitters,
    "table": lambda: Sheet(None, TextTable("t", "Times", ("method", "ms"), (("auto", "1.2"), ("gtrs", "0.3")))),
}


@cache
def value(name):
    return MAKERS[name]()


@pytest.mark.parametrize("name", MAKERS)
def test_a_short_form_is_short(name):
    text = repr(value(name))
    assert text.count("\n") < LINES
    assert len(text) <= CHARACTERS
    assert "next" in text.splitlines()[-1]
    assert "object at" not in text
    # The text of a row may continue on further lines, and the last row is the next call.
    assert value(name)._repr_html_().count("<tr>") == len(short_form_of(value(name)).rows) + 1


def test_the_main_numbers_are_in_it():
    assert "batch" not in repr(value("problem"))
    assert "100 problems of 4 rows, 4 stations, 2 dimensions" in repr(value("batch of problems"))
    assert "160 range" in repr(value("run"))
    followed_run = value("track")
    assert status_counts(followed_run.code) in repr(followed_run)
    assert f"{followed_run.position[-1][0]:.2f} ± " in repr(followed_run)
    low, high = value("region").box
    assert f"x {low[0]:.6g} to {high[0]:.6g} m" in repr(value("region"))
    assert "2 variables, 0 constraints (CasADi)" in repr(value("posed program"))
    assert repr(value("emitters")).startswith("1 emitter\n")


def test_long_names_and_many_rows_are_cut():
    rows = tuple((f"label {i}" * 30, "text" * 300) for i in range(40))
    form = ShortForm("title" * 300, rows, "value.position")
    assert text_of_form(form).count("\n") < LINES
    assert html_of_form(form).count("<tr>") < LINES
    assert text_of_form(form).endswith("value.position")


def test_names_in_html_are_data():
    assert "<b>" not in html_of_form(ShortForm("<b>", (("<b>", "<b>"),), "<b>"))


def test_of_many_names_the_first_are_listed():
    assert listed(["a", "b", "c"], 2) == "a, b and 1 more"
    assert status_counts(np.array([1, 0, 0])) == "2 ok, 1 ambiguous"


def test_every_entry_is_tested():
    kinds = {base.__name__ for name in MAKERS for base in type(value(name)).__mro__}
    assert FORMS.keys() <= kinds
