"""The notebooks of the documentation run without an error or a warning, and their stored outputs are the fresh ones.

``OPTLOC_WRITE_DOCS=1 pytest -m slow tests/test_notebooks.py`` stores the outputs in the notebooks.
"""

import os
import re

import nbformat
import pytest
from doc_notebooks import NOTEBOOKS, executed, outputs, pages_of, run_cells, shown
from doc_pages import DOCS

from optloc.kernels.jit import enabled

TITLES = ("first-fix", "placement", "registration", "study", "tracking")
LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")
# Tables of pandas have this class; other tables are answers of optloc.
FRAME = 'class="dataframe"'


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def path(request):
    return request.param


def test_the_notebooks_are_the_listed_ones():
    assert tuple(path.stem for path in NOTEBOOKS) == TITLES
    index = (DOCS / "notebooks" / "index.md").read_text(encoding="utf-8")
    assert [name for name in TITLES if f"]({name}.ipynb)" not in index or f"\n{name}\n" not in index] == []


def test_a_notebook_is_valid_short_and_explained(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert 10 <= len(notebook.cells) <= 20
    texts = pages_of(notebook)
    assert texts[0].startswith("# ")
    assert any("status is not `ok`" in text or "not good enough" in text for text in texts)
    assert "## Read on" in texts[-1]


def test_links_of_a_notebook_lead_to_files(path):
    targets = LINK.findall("\n".join(pages_of(nbformat.read(path, as_version=4))))
    assert targets
    assert [target for target in targets if not (path.parent / target).exists()] == []


def test_no_stored_output_is_an_error_or_names_a_folder_of_a_user(path):
    notebook = nbformat.read(path, as_version=4)
    assert [number for number, output in outputs(notebook) if output.output_type == "error"] == []
    assert [text for text in shown(notebook) if re.search(r"/(?:home|tmp|root|work|Users)/", text[2])] == []


@pytest.mark.slow
def test_a_notebook_runs_and_shows_what_is_stored(path, tmp_path):
    stored, fresh = nbformat.read(path, as_version=4), executed(path, tmp_path)
    assert [output.text for _, output in outputs(fresh) if output.get("name") == "stderr"] == []
    kinds = [kind for _, output in outputs(fresh) for kind in output.get("data", {})]
    assert "image/png" in kinds
    tables = [output.data["text/html"] for _, output in outputs(fresh) if "text/html" in output.get("data", {})]
    assert any(FRAME not in table for table in tables), "no answer of optloc is shown"
    if os.environ.get("OPTLOC_WRITE_DOCS"):
        nbformat.write(fresh, path)
    elif enabled():  # the proofs that are shown need machine code
        assert shown(fresh) == shown(stored)


# The task "load a file, fix it, show the picture", and each picture function as the last line of its cell.
FILE = """
format = 2
[stations]
rows = [{name="A", x=0, y=0}, {name="B", x=900, y=0}, {name="C", x=900, y=800}, {name="D", x=0, y=800}]
[[measurements]]
kind = "range"
unit = "m"
sigma = 1.0
rows = [{a="A", z=500.4}, {a="B", z=671.2}, {a="C", z=781.3}, {a="D", z=640.1}]
"""
BEFORE = """
import numpy as np
import optloc
from optloc import show
problem = optloc.load("site.toml")
fix = optloc.solve(problem)
GRID = np.linspace(0.0, 900.0, 9)
"""
LAST_LINES = (
    "show.plot_fixes(problem, fix)",
    "show.plot_residuals(problem, fix)",
    "show.plot_landscape(problem, fix)",
    "show.plot_convergence(problem, fix, starts=21)",
    "bound = optloc.bounds.bound_map(problem, fix.x, GRID, GRID)\nshow.plot_bound_map(bound)",
    "fix.plot()",
    "problem.plot()",
)


@pytest.mark.slow
def test_each_picture_is_shown_below_its_cell_without_a_magic_command(tmp_path):
    (tmp_path / "site.toml").write_text(FILE, encoding="utf-8")
    cells = [nbformat.v4.new_code_cell(text) for text in (BEFORE, *LAST_LINES)]
    found = outputs(run_cells(nbformat.v4.new_notebook(cells=cells), tmp_path))
    pictures = [number for number, output in found if "image/png" in output.get("data", {})]
    assert pictures == list(range(1, len(cells)))  # one picture for each cell, and none twice
    assert [output for _, output in found if output.output_type in ("stream", "error")] == []


@pytest.mark.slow
def test_a_cell_stores_no_progress(tmp_path):
    work = "with {0}:\n    for k in range(24):\n        tell({1}); time.sleep(0.1)"
    before = "import time\nfrom optloc.cli.output import bar, line, meter\n"
    calls = (
        ("meter('work', False) as tell", "k, 24"),
        ("line(False) as tell", "'work'"),
        ("bar('work', 24, False) as tell", "1"),
    )
    cells = [nbformat.v4.new_code_cell(before + work.format(*call)) for call in calls]
    assert outputs(run_cells(nbformat.v4.new_notebook(cells=cells), tmp_path)) == []
