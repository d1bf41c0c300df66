"""Notebooks of the documentation: executed in a kernel of their own, and compared with the outputs that are stored."""

import os
import re
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "docs" / "notebooks").glob("*.ipynb"))
# Seconds for one cell on a machine that is busy and makes machine code.
_LIMIT = 600
# The first run on a machine stores machine code and writes its progress to stderr.
_PROGRESS = re.compile(r"(?:making|loading) machine code\b.*\n?")
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")


def executed(path, folder):
    """Return the notebook with fresh outputs, executed in `folder`; an error in a cell raises CellExecutionError."""
    notebook = nbformat.read(path, as_version=4)
    # Jupyter selects the backend that shows figures below their cells, unless the environment names another backend.
    kept = {name: os.environ.pop(name) for name in ("MPLBACKEND", "PYTHONWARNINGS") if name in os.environ}
    try:
        client = NotebookClient(notebook, timeout=_LIMIT, resources={"metadata": {"path": str(folder)}})
        client.create_kernel_manager()
        # The kernel of this interpreter, whatever kernels the user has installed.
        client.km.kernel_spec.argv[0] = sys.executable
        client.execute()
    finally:
        os.environ.update(kept)
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # times
    notebook.metadata["language_info"] = {"name": "python"}
    return notebook


def outputs(notebook):
    """Yield the number of the cell and each output of the notebook."""
    for number, cell in enumerate(notebook.cells):
        for output in cell.get("outputs", ()):
            yield number, output


def complaints(notebook):
    """Return the texts that the cells wrote to stderr, without the progress of the compilation."""
    texts = [(number, output.text) for number, output in outputs(notebook) if output.get("name") == "stderr"]
    cleaned = [(number, _PROGRESS.sub("", text).strip()) for number, text in texts]
    return [f"cell {number}: {text}" for number, text in cleaned if text]


def mime_types(notebook):
    """Return the content types of all outputs, and for HTML whether it is a table of optloc."""
    return [kind for _, output in outputs(notebook) for kind in output.get("data", {})]


def shown(notebook):
    """Return the texts of each cell that a reader sees, without pictures and spaces."""
    found = []
    for number, output in outputs(notebook):
        if output.get("name") == "stderr":
            continue
        texts = [output.text] if "text" in output else [output.data[kind] for kind in output.get("data", {}) if kind.startswith("text/")]
        found += [(number, " ".join(_ADDRESS.sub("", text).split())) for text in texts]
    return found


def without_progress(notebook):
    """Return the notebook without the outputs of stderr."""
    for cell in notebook.cells:
        if "outputs" in cell:
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
    return notebook
