"""A picture has an image for notebooks, and is an ordinary figure in all other respects."""

import pickle
from io import BytesIO

from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from PIL import Image

from optloc.show.pictures.style import figure_class


def test_a_picture_has_an_image_without_pyplot():
    picture = figure_class()(figsize=(4.0, 3.0))
    picture.subplots().plot([0, 1], [1, 0])
    with Image.open(BytesIO(picture._repr_png_())) as image:
        assert image.format == "PNG"
        assert image.size == (480, 360)
        assert len(image.convert("L").getcolors()) > 2
    assert plt.get_fignums() == []


def test_a_picture_is_a_figure_that_processes_exchange():
    picture = figure_class()(figsize=(4.0, 3.0))
    assert isinstance(picture, Figure)
    assert isinstance(pickle.loads(pickle.dumps(picture)), figure_class())
