"""The recipe for FilterPy of the documentation: its extended filter, started by optloc, is ours."""

import re
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("filterpy", reason="FilterPy is not installed")

import optloc
from optloc.tracking import begun, followed, polynomial

PAGE = Path(__file__).resolve().parents[2] / "docs" / "tracking.md"


def test_the_recipe_gives_our_track():
    recipe = re.search(r"```python\n(from filterpy.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
    problem, dynamics = optloc.load(files("optloc") / "scenarios" / "run.toml"), polynomial(1, 1.0)
    names = {}
    exec(recipe, names)
    times, means = names["filterpy_track"](problem, dynamics)
    ours = followed(problem, begun(problem, dynamics), dynamics, "ekf")
    np.testing.assert_allclose(times, ours.times)
    np.testing.assert_allclose(means, ours.mean, rtol=1e-8, atol=1e-8)
