"""What pictures share: names as they are, units that read well, ellipses of 95 %, and files by their endings."""

import itertools

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from PIL import Image
from scipy.stats import chi2

from optloc import InvalidProblem
from optloc.show.pictures.bound_map import COLOURS
from optloc.show.pictures.landscape import COLOURS as COSTS
from optloc.show.pictures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    YELLOW,
    description,
    ellipse_line,
    finish,
    literal,
    panels_for,
    save,
    unit_of,
)


def test_text_is_shown_letter_by_letter():
    assert literal("a $x$") == r"a \$x\$"
    assert literal("_hidden") == " _hidden"
    assert literal("a\n  b") == "a b"
    assert len(literal("x" * 500)) == 120


@pytest.mark.parametrize(("reach", "unit"), [(0.5, "mm"), (20.0, "m"), (4999.0, "m"), (5000.0, "km")])
def test_lengths_are_in_the_unit_that_reads_best(reach, unit):
    assert unit_of(np.array([[0.0, -reach], [np.nan, 0.1]]))[0] == unit


def test_a_ring_is_where_the_chi_square_is_that_of_95_percent():
    cov = np.array([[9.0, 2.0], [2.0, 4.0]])
    edge = ellipse_line(cov)
    assert np.einsum("ni,ij,nj->n", edge, np.linalg.inv(cov), edge) == pytest.approx(
        np.full(len(edge), chi2.ppf(0.95, 2))
    )
    assert edge[0] == pytest.approx(edge[-1])


def test_pictures_are_written_by_their_ending(tmp_path):
    figure, panels = panels_for(3, 2, 1.0, 1.0)
    assert (len(panels), len(figure.axes)) == (3, 4)
    save(figure, tmp_path / "p.svg")
    assert (tmp_path / "p.svg").read_text(encoding="utf-8").lstrip().startswith("<?xml")
    with pytest.raises(InvalidProblem, match=r"type '\.doc'"):
        save(figure, tmp_path / "p.doc")


# Linear RGB as it is seen without the cones for red (protanopia) and for green (deuteranopia): Machado et al. (2009).
VISIONS = {
    "usual": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
}


def lab(colour, vision):
    """Return a colour as CIE L*a*b*, as it is seen with a vision."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(VISIONS[vision]) @ linear, 0.0, 1.0)
    matrix = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    x, y, z = np.cbrt(np.maximum(matrix @ seen / [0.9505, 1.0, 1.089], 1e-3))
    return np.array([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)])


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize("palette", [(BLUE, ORANGE, BLACK), (PURPLE, SKY, GREEN, YELLOW)])
def test_colours_of_one_panel_differ_with_any_colour_vision(palette, vision):
    seen = [lab(colour, vision) for colour in palette]
    # 10 is several times the smallest difference that is visible between neighbouring areas
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)) > 10.0


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize("name", [COLOURS, COSTS])
def test_colour_scales_become_steadily_darker_with_any_colour_vision(name, vision):
    lightness = [lab(colour, vision)[0] for colour in colormaps[name](np.linspace(0.0, 1.0, 12))[:, :3]]
    assert (np.diff(lightness) < 0.0).all() or (np.diff(lightness) > 0.0).all()


def test_files_have_a_title_and_an_alternative_text(tmp_path):
    figure, (panel,) = panels_for(1, 1, 4.0, 3.0)
    panel.plot([0.0, 1.0], [0.0, 1.0], label="a < b")
    panel.set(xlabel="time (s)", ylabel="sigma (m)")
    finish(figure, "A drive", [panel])
    text = "A drive. Panel time (s) and sigma (m) shows a < b."
    assert description(figure) == text
    save(figure, tmp_path / "p.svg")
    svg = (tmp_path / "p.svg").read_text(encoding="utf-8")
    assert "<title>A drive</title>" in svg
    assert f"<desc>{text.replace('<', '&lt;')}</desc>" in svg
    save(figure, tmp_path / "p.png")
    with Image.open(tmp_path / "p.png") as image:
        assert (image.info["Title"], image.info["Description"]) == ("A drive", text)
