"""Notebooks of the documentation: executed in a kernel of their own, and their outputs as texts."""

import os
import re
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "docs" / "notebooks").glob("*.ipynb"))
# Seconds for one cell on a machine that is busy and makes machine code.
_LIMIT = 600
# Matplotlib prints the size of a figure, which depends on its version; the picture is next to it.
_FIGURE = re.compile(r"<\w*Figure size .*>")


def executed(path, folder):
    """Return the notebook with fresh outputs, executed in `folder`; see `run_cells`."""
    notebook = run_cells(nbformat.read(path, as_version=4), folder)
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # times
    notebook.metadata["language_info"] = {"name": "python"}
    return notebook


def run_cells(notebook, folder):
    """Return a notebook after the execution of its cells in `folder`; an error in a cell raises CellExecutionError."""
    # The kernel itself selects the backend that shows figures below their cells, unless the environment names another.
    kept = {name: os.environ.pop(name) for name in ("MPLBACKEND",) if name in os.environ}
    try:
        client = NotebookClient(notebook, timeout=_LIMIT, resources={"metadata": {"path": str(folder)}})
        client.create_kernel_manager()
        client.km.kernel_spec.argv[0] = sys.executable  # not the kernel of another environment of the user
        client.execute()
    finally:
        os.environ.update(kept)
    return notebook


def outputs(notebook):
    """Return pairs of the number of a cell and one of its outputs."""
    return [(number, output) for number, cell in enumerate(notebook.cells) for output in cell.get("outputs", ())]


def shown(notebook):
    """Return the number of a cell, the type and the words of each output that is text."""
    found = []
    for number, output in outputs(notebook):
        texts = {output.name: output.text} if "text" in output else output.get("data", {})
        found += [
            (number, kind, " ".join(_FIGURE.sub("", text).split()))
            for kind, text in sorted(texts.items())  # files have them in another order
            if not kind.startswith("image/")
        ]
    return found


def pages_of(notebook):
    """Return the text cells of a notebook."""
    return [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]
