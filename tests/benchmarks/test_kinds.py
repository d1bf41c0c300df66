"""One fix of every kind: `pytest -m full tests/benchmarks/test_kinds.py` writes the table, in a quiet moment."""

import platform

import numba
import numpy as np
import pytest
import scipy
from benchmarks import kinds_of_work
from benchmarks.kinds import FAST, KINDS, TRIALS
from benchmarks.kinds_table import (
    ANSWERS,
    HEADER,
    ROUNDS,
    cells,
    changes,
    measured_apart,
    processor,
    read_table,
    with_jax,
)
from monte_carlo.tables import FOLDER, write

from optloc.kernels.jit import enabled
from optloc.tracking.updates import UPDATES

pytestmark = pytest.mark.skipif(not enabled(), reason="times of machine code")
STORED = FOLDER / "kinds.md"


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_derivatives_of_opponents_are_exact(kind):
    """Central differences agree to 1e-5: a step of 0.1 mm leaves six digits of a length of 10 km."""
    p = kind.drawn[0][0]
    step = 1e-4 * np.maximum(np.abs(p), 1.0) if kind.opponent.scale != "jac" else np.full(len(p), 1e-6)
    value, slope = kind.opponent.rows.value, kind.opponent.rows.slope(p)
    numeric = [(value(p + h) - value(p - h)) / (2.0 * h.sum()) for h in np.diag(step)]
    assert np.allclose(slope, np.transpose(numeric), rtol=1e-5, atol=1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("name", list(UPDATES))
def test_filters_are_those_of_numpy(name):
    """Mean and covariance after a scan are those of the opponent, in standard deviations."""
    for z in kinds_of_work.scans()[:TRIALS]:
        mean, cov = kinds_of_work.filtered(name, z)
        ours, theirs = kinds_of_work.prior_and_scan(name, z)
        sigma = np.sqrt(np.diag(cov))
        assert np.abs((ours - mean) / sigma).max() < 1e-6
        assert np.abs((theirs - cov) / np.outer(sigma, sigma)).max() < 1e-6


def named(row):
    """Return the cells of a row by column."""
    return dict(zip(HEADER, cells(row), strict=True))


def test_the_answers_are_those_of_the_table(tmp_path):
    stored = read_table(STORED)
    rows = [named(row) for row in measured_apart(tmp_path, answers_alone=True)]
    assert [row["kind"] for row in rows] == list(stored)
    found = [change for row in rows for change in changes(row, stored[row["kind"]])]
    assert not found, "\n".join(found)


def test_another_answer_is_found():
    """A status, a cost by 2e-6 and an error by 2e-4 are changes; less is rounding."""
    row = {"kind": "a", **dict.fromkeys(ANSWERS, ""), "statuses": "12 ok", "cost": "10", "error, m": "5"}
    assert not changes(row, row)
    assert not changes(row | {"cost": "10.000005"}, row)
    for other in ({"statuses": "11 ok, 1 misfit"}, {"cost": "10.00002"}, {"error, m": "5.001"}, {"cost": "nan"}):
        assert len(changes(row | other, row)) == 1


@pytest.mark.full
def test_write_the_table(tmp_path):
    found = measured_apart(tmp_path)
    # No answer costs more than SciPy's from the truth.
    assert not [row.name for row in found if "higher" in row.answers["same cost, auto"]]
    header, rows, jax = [*HEADER], [cells(row) for row in found], with_jax(tmp_path, found)
    if jax is not None:
        header, rows = [*header, "JAX"], [[*row, jax.get(row[0], "")] for row in rows]
    unit = 1e6 * min(unit for row in found for unit in row.units.values())
    facts = (
        f"{TRIALS} seeded problems a row, fewer in calibration; the quietest of up to {ROUNDS} rounds; "
        f"S is {unit:.0f} us; prepare, solve and batch use {FAST}; "
        f"numpy {np.__version__}, SciPy {scipy.__version__}, numba {numba.__version__}, "
        f"Python {platform.python_version()}; {processor()}; one thread"
    )
    assert write("kinds", header, rows, facts + ("; JAX is not installed" if jax is None else "")).is_file()
