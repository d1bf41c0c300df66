"""Pictures of the gallery: the figure that an example made."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sphinx_gallery.scrapers import figure_rst

from optloc.show.pictures.style import description


def figures(block: tuple[Any, ...], variables: dict[str, Any], conf: dict[str, Any]) -> str:
    """Write the example's ``figure`` for its page, and return the text that shows it."""
    figure = variables["example_globals"].pop("figure", None)
    if figure is None:
        return ""
    path = Path(next(variables["image_path_iterator"]))
    figure.savefig(path, dpi=110)
    return str(figure_rst([str(path)], conf["src_dir"], description(figure)))
