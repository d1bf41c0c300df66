"""The notebooks of the documentation run without an error or a warning, and their stored outputs are the fresh ones.

``OPTLOC_WRITE_DOCS=1 pytest -m slow tests/test_notebooks.py`` stores the outputs in the notebooks.
"""

import os
import re

import nbformat
import pytest
from doc_notebooks import NOTEBOOKS, executed, outputs, pages_of, shown
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
