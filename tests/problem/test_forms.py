"""Forms of biases: one table that all other code asks, so that one entry adds a form."""

import ast
import re
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from sources import nodes, walked

from optloc import InvalidProblem, Motion, Status, assemble, measured, simulate, solve, with_bias
from optloc.base.types import FormName, Stations
from optloc.engine import predict
from optloc.problem.bias import with_known_bias
from optloc.problem.forms import FORMS, BiasForm
from optloc.proof.scope import why_unsupported
from optloc.tracking.constants import begun_with_constants
from optloc.tracking.dynamics import polynomial

ROOT = Path(__file__).resolve().parents[2]
OWNER = ROOT / "optloc/problem/forms.py"
# Its keys are causes of a misfit, and some causes have the name of a form.
CAUSES = ROOT / "optloc/advice/explanation_table.py"


def test_type_checkers_know_the_forms_of_the_table():
    assert get_args(FormName) == tuple(FORMS)


# The names of forms are compared in one file.


def is_form(node):
    """Return whether an expression is the form of something: `form`, or `bias.form`."""
    return getattr(node, "id", getattr(node, "attr", "")) == "form"


def form_names(node):
    return {each.value for each in walked(node) if isinstance(each, ast.Constant)} & FORMS.keys()


def decides(node):
    """Return whether a node of a syntax tree makes the name of a form decide something."""
    if isinstance(node, ast.Compare):
        sides = [node.left, *node.comparators]
        return any(map(is_form, sides)) and any(map(form_names, sides))
    if isinstance(node, ast.Match):
        return is_form(node.subject) and any(form_names(case.pattern) for case in node.cases)
    if isinstance(node, ast.Dict):  # a table by form in another file
        return len({key.value for key in node.keys if isinstance(key, ast.Constant)} & FORMS.keys() - {"time"}) > 1
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in ("get", "index"):
        return any(map(is_form, node.args)) and bool(form_names(node.func.value))
    return isinstance(node, ast.Subscript) and is_form(node.slice) and bool(form_names(node.value))


def mentions(path):
    """Return whether a file names a form at all: only then is it worth parsing."""
    return re.search(rf"[\"']({'|'.join(FORMS)})[\"']", path.read_text(encoding="utf-8"))


def decisions(tree):
    return [node.lineno for node in tree if decides(node)]


@pytest.mark.parametrize(
    "source",
    [
        'bias.form == "walk"',
        'one.bias.form not in ("offset", "drift")',
        '"scale" != form',
        '{"rotation": 3}.get(bias.form, 1)',
        '{"rotation": 3}[form]',
        'table = {"scale": 1, "rotation": 2}',
        'match bias.form:\n    case "walk" | "spline":\n        pass',
    ],
)
def test_a_comparison_is_found(source):
    assert decisions(walked(ast.parse(source)))
    assert not decisions(walked(ast.parse('with_bias(problem, "clock", form="walk"); FORMS[bias.form]; form == "raw"')))


def test_no_other_file_compares_the_names_of_forms():
    files = [path for path in (ROOT / "optloc").rglob("*.py") if path not in (OWNER, CAUSES) and mentions(path)]
    found = [f"{path.relative_to(ROOT)}:{line}" for path in files for line in decisions(nodes(path))]
    assert not found


# One entry adds a form.

TIMES = np.arange(12.0)
STATIONS = Stations(np.array([[[0.0, 0.0], [5e3, 1e3], [-2e3, 6e3], [3e3, -4e3], [-4e3, -3e3]]]), tuple("ABCDE"))


def in_square_of_time(bias, times, origin, epoch):
    return bias.member[:, None], (bias.coefficient * (times - origin)[epoch] ** 2)[:, None]


def run_of(motion=None):
    epoch, station = np.divmod(np.arange(5 * len(TIMES)), 5)
    rows = measured("range", a=station, epoch=epoch, sigma=1.0)
    return assemble(STATIONS, rows, times=TIMES, motions=(motion or Motion(0),))


def test_one_entry_adds_a_form(monkeypatch):
    reason = "grows with the square of time, and this proof takes lines"
    monkeypatch.setitem(FORMS, "bend", BiasForm("a bend", rate=True, effects=in_square_of_time, beyond_proof=reason))
    problem = with_bias(run_of(), "clock", form="bend", members=["B", "C"])
    slot, shared = problem.layout.find("clock")
    assert (slot.size, slot.unit, shared) == (2, "m/s", True)
    truth = np.array([700.0, -900.0, 0.8, -0.5])
    since = np.where(np.isin(problem.rows[0].a, [1, 2]), TIMES[problem.epoch] ** 2, 0.0)
    size = np.choose(problem.rows[0].a, [0.0, 0.8, -0.5, 0.0, 0.0])
    np.testing.assert_allclose(predict(problem, truth), predict(run_of(), truth[:2]) + size * since, atol=1e-9)
    data = simulate(problem, truth, 4)
    fix = solve(data)
    off = fix.x - truth
    assert off @ np.linalg.solve(fix.cov[:4, :4], off) < 18.5  # chi-square of 4 numbers at 0.1 %
    known = with_known_bias(data, "clock", truth[2:])
    np.testing.assert_allclose(known.observed - predict(run_of(), truth[:2]), data.z - predict(data, truth), atol=1e-9)
    assert why_unsupported(data.flat()) == f"the bend 'clock' {reason}"
    assert not fix.status & Status.OK or fix.certificate.proof != "global"
    moving = with_bias(run_of(Motion(1)), "clock", form="bend", members=["B"])
    with pytest.raises(InvalidProblem, match="the bend 'clock' changes with time"):
        begun_with_constants(moving, polynomial(1, 1.0), 3)


def test_an_unknown_form_of_a_bias_made_by_hand_is_named():
    made = with_bias(run_of(), "clock", members=["B"])
    strange = replace(made, biases=(replace(made.biases[0], form="ofset"),))
    with pytest.raises(InvalidProblem, match=r"bias 'clock': unknown form 'ofset'; use offset, scale"):
        predict(strange, np.zeros(3))
