"""Configuration of the documentation; nothing is fetched while it is built."""

from importlib.metadata import version as installed_version

project = "optloc"
author = "optloc contributors"
copyright = "2026, optloc contributors"
release = version = installed_version("optloc")

extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"optloc {release}"

myst_enable_extensions = ["colon_fence", "dollarmath", "deflist"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "none"
# Attributes and methods follow from the members themselves, in their own place.
numpydoc_show_class_members = False
