"""One of six bearings is off by 20 to 80 degrees: the advice names its station, not a unit or the compass."""

from collections import Counter

import numpy as np
import pytest
from advice.marks import causes

import optloc
from optloc.advice import advise

SEED, SHORT, FULL = 68, 12, 400
STATIONS, EXTENT = 6, 8e3


def file_text(seed: int) -> tuple[str, int]:
    """Return a file with bearings in degrees of 1 degree, and the number of the station that is wrong."""
    rng = np.random.default_rng([SEED, seed])
    place = rng.uniform(-1.0, 1.0, (STATIONS, 2)) * EXTENT
    x = rng.uniform(-1.0, 1.0, 2) * EXTENT
    guilty = int(rng.integers(STATIONS))
    bearing = np.degrees(np.arctan2(x[0] - place[:, 0], x[1] - place[:, 1])) + rng.normal(size=STATIONS)
    bearing[guilty] += rng.choice([-1.0, 1.0]) * rng.uniform(20.0, 80.0)
    stations = ", ".join(f'{{name="S{i}", x={p:.3f}, y={q:.3f}}}' for i, (p, q) in enumerate(place))
    rows = ", ".join(f'{{a="S{i}", z={value:.4f}}}' for i, value in enumerate(bearing % 360.0))
    text = f"format = 2\n[stations]\nrows = [{stations}]\n"
    return text + f'[[measurements]]\nkind = "bearing"\nsigma = 1.0\nrows = [{rows}]\n', guilty


def counted(count, folder) -> Counter:
    """Return the first causes of the files that are a misfit, and how often the first advice names the station."""
    out, file = Counter(), folder / "bearings.toml"
    for seed in range(count):
        text, guilty = file_text(seed)
        file.write_text(text, encoding="utf-8")
        problem = optloc.load(file)
        fix = optloc.solve(problem)
        if fix.status.label != "misfit":
            continue
        advice = causes(advise(problem, fix))
        out["misfit"] += 1
        out[advice[0][0] if advice else "nothing"] += 1
        out["guilty first"] += bool(advice) and advice[0][1] == (guilty,)
    return out


@pytest.mark.parametrize("count", [SHORT, pytest.param(FULL, marks=pytest.mark.full)])
def test_the_wrong_bearing_is_named(count, tmp_path):
    found = counted(count, tmp_path)
    assert found["misfit"] > count / 2
    assert found["guilty first"] >= 0.9 * found["misfit"]
    assert found["unit"] + found["compass"] <= 0.02 * found["misfit"]
