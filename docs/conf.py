"""Configuration of the documentation; nothing is fetched while it is built or read."""

import sys
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from generated import filled  # the folder is no package

project = "optloc"
author = "optloc contributors"
copyright = "2026, optloc contributors"
release = version = installed_version("optloc")

extensions = [
    "myst_nb",  # pages and notebooks; it contains myst_parser
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "sphinx_design",  # cards of the front page
    "sphinx_gallery.gen_gallery",
    "sphinx-mathjax-offline",  # MathJax and its fonts lie beside the pages
]
# The changes are parts of CHANGELOG.md. The gallery offers its notebooks as downloads beside its pages.
exclude_patterns = ["_build", "changes", "examples", "gallery/*.ipynb"]
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_title = f"optloc {release}"

myst_enable_extensions = ["colon_fence", "dollarmath", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # the notebooks are stored with their outputs, and a test repeats them
nb_ipywidgets_js = {}  # no notebook has widgets, whose scripts come from elsewhere

autodoc_member_order = "bysource"
autodoc_typehints = "none"
# Attributes and methods follow from the members themselves, in their own place.
numpydoc_show_class_members = False

sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "gallery",
    "filename_pattern": "/plot_",
    "within_subsection_order": "FileNameSortKey",
    "image_scrapers": ("scraper.figures",),
    "reset_modules": (),
    "capture_repr": (),
    "remove_config_comments": True,
    "show_memory": False,
    "show_signature": False,
    "download_all_examples": False,
    "write_computation_times": False,
    "min_reported_time": 1e9,
    "abort_on_example_error": True,
}


def _fill(app: Any, page: str, source: list[str]) -> None:
    source[0] = filled(source[0])


def setup(app: Any) -> None:
    """Fill in what is generated before a page is read."""
    app.connect("source-read", _fill)
