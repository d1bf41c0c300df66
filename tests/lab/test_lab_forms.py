"""Short forms of studies and of their results: at most 15 lines, with the methods by name."""

import pytest
from lab.study.texts import QUICK, run_here

from optloc.lab.lab_forms import FORMS
from optloc.lab.study.design import design_of
from optloc.lab.study.folder import progress, read_frame, read_manifest
from optloc.lab.study.histories import histories, trials_of
from optloc.lab.study.paired import paired
from optloc.lab.study.profiles import profiles, shares
from optloc.lab.study.summary import COLUMNS, compared, judged


@pytest.fixture(scope="module")
def values(tmp_path_factory):
    """Return the values of a study by class: its design, its folder, and results of it."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "s.toml").write_text(QUICK + '[[method]]\nmethod = "roots+lsr"\n')
    design = design_of(folder / "s.toml")
    run_here(design, folder / "out")
    frame = read_frame(folder / "out", COLUMNS)
    trials = trials_of(folder / "out", (), 3, None, None)
    found = [
        design,
        read_manifest(folder / "out"),
        progress(folder / "out"),
        profiles(frame),
        trials,
        histories(trials),
        paired(judged(frame), "gtrs+lsr")[0],
        compared(folder / "out", folder / "out")[0],
    ]
    return {type(value).__name__: value for value in found}


@pytest.mark.parametrize("name", FORMS)
def test_a_short_form_is_short_and_has_an_html_form(values, name):
    text = repr(values[name])
    assert text.count("\n") < 15
    assert len(text) <= 1000
    assert "object at" not in text
    assert "Parameters" not in text
    assert values[name]._repr_html_().startswith('<table class="answer"><caption>')


def test_the_main_numbers_are_in_it(values):
    state = values["Progress"]
    assert f"complete, {state.rows} of {state.manifest.rows} rows" in repr(state)
    for method, status in state.methods:
        assert f"{state.methods[method, status]} {status}" in repr(state)
    best = shares(values["Profiles"])[0]
    assert best.method in repr(values["Profiles"])
    assert values["Pair"].against in repr(values["Pair"])
    assert "identical" in repr(values["Difference"])
    assert str(values["StudyDesign"].rows) in repr(values["StudyDesign"])
