"""A kind with a proof from another package: one entry point and one file, and its certificates hold."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from proof import squared_range
from proof.sampling import rotation
from recipes import write_package
from scipy.optimize import least_squares

from optloc.base.errors import InvalidProblem
from optloc.kernels.jit import enabled
from optloc.models import MODELS
from optloc.proof.nodes.dispatch import NODES, code_of, named, text_of
from optloc.proof.nodes.node import RANGE

HERE, STATIONS, SIGMA, TRIALS = Path(__file__).parents[1], 5, 2e5, 12

# What another process does with the package installed: it asks for fixes like of any kind, and prints what is proven.
SCRIPT = """
import json, sys
import numpy as np
import optloc
given = {name: np.array(value) for name, value in json.load(sys.stdin).items()}
rows = [optloc.measured("squared_range", given["z"], a=np.arange(given["z"].shape[-1]), sigma=float(given["sigma"]))]
if "tdoa" in given:
    rows.append(optloc.measured("tdoa", given["tdoa"], a=[1, 2, 3], b=0, arrival_sigma=10.0))
problem = optloc.assemble(given["stations"][:, None], *rows)
fix = optloc.solve(problem)
fix = optloc.certify(problem, fix)
out = [[c.proof, c.unique, c.bound, c.margin, c.reason] for c in fix.certificate]
print(json.dumps([out, fix.position.tolist(), fix.cost.tolist(), fix.alternatives.gap.tolist()]))
"""


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    folder = tmp_path_factory.mktemp("squares")
    text = (HERE / "squared_range.py").read_text(encoding="utf-8")
    write_package(
        folder,
        {"squared_range.py": text},
        name="squares",
        entries={"optloc.models": {"squared_range": "squared_range:KIND"}},
    )
    return folder


def elsewhere(folder, given, machine):
    """Return what a process of its own, with the package installed, proves; in machine code or in plain Python."""
    path = os.pathsep.join([str(folder), *sys.path])
    setting = {} if machine else {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        input=json.dumps({name: np.asarray(value).tolist() for name, value in given.items()}),
        env=os.environ | {"PYTHONPATH": path} | setting,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def drawn(rng, d):
    """Return stations, truths and squared ranges of some trials; half of the arrays are nearly in line or in plane."""
    stations = rng.uniform(-5e3, 5e3, (TRIALS, STATIONS, d))
    stations[::2, :, -1] *= 0.02
    truth = rng.uniform(-8e3, 8e3, (TRIALS, d))
    z = ((truth[:, None] - stations) ** 2).sum(-1) + SIGMA * rng.standard_normal((TRIALS, STATIONS))
    return stations, truth, z


def minima(stations, z, tdoa, truth, rng):
    """Return the costs of the minima that SciPy reaches from many starts, with formulas of its own."""

    def residual(x):
        apart = x - stations
        squares = (apart**2).sum(-1)
        out = [(squares - z) / SIGMA]
        if tdoa is not None:
            r = np.sqrt(squares)[:4]
            root = np.linalg.cholesky(100.0 * (np.eye(3) + 1.0))
            out.append(np.linalg.solve(root, r[1:] - r[0] - tdoa))
        return np.concatenate(out)

    starts = [truth, *rng.uniform(-2e4, 2e4, (30, len(truth)))]
    return np.array([2.0 * least_squares(residual, start, x_scale=1e3, xtol=1e-14).cost for start in starts])


# A node from outside has the whole proof compiled anew, which takes minutes: every run has the plain form of it, and in
# machine code what the node is asked.
MACHINE = [
    pytest.mark.full,
    pytest.mark.skipif(not enabled(), reason="plain Python takes a thousand times longer for a box"),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("d", "machine"), [(2, False), pytest.param(2, True, marks=MACHINE), pytest.param(3, True, marks=MACHINE)]
)
def test_a_kind_from_outside_gets_certificates_that_hold(package, d, machine):
    rng = np.random.default_rng(d)
    stations, truth, z = drawn(rng, d)
    given = {"stations": stations, "z": z, "sigma": SIGMA}
    certificates, _, cost, gap = elsewhere(package, given, machine)
    proven = unique = 0
    for i, (proof, alone, bound, margin, _) in enumerate(certificates):
        least = np.sort(minima(stations[i], z[i], None, truth[i], rng))
        if proof == "global":
            proven += 1
            slack = 1e-6 * (1.0 + cost[i])
            assert bound <= least[0] + slack
            assert cost[i] <= least[0] + slack
            if alone:
                unique += 1
                near = least[(least > cost[i] + 1e-3) & (least < cost[i] + margin - 1e-3)]
                listed = cost[i] + np.array([g for g in gap[i] if g is not None])
                assert all(np.abs(listed - c).min(initial=np.inf) < 1e-2 * (1.0 + c) for c in near)
    assert proven >= TRIALS - 1
    assert unique >= TRIALS // 2


@pytest.mark.full
@pytest.mark.skipif(not enabled(), reason="plain Python takes a thousand times longer for a box")
def test_it_mixes_with_kinds_that_optloc_has(package):
    rng = np.random.default_rng(7)
    stations, truth, z = drawn(rng, 3)
    r = np.linalg.norm(truth[:, None] - stations[:, :4], axis=-1) + 10.0 * rng.standard_normal((TRIALS, 4))
    tdoa = r[:, 1:] - r[:, :1]
    certificates, _, cost, _ = elsewhere(package, {"stations": stations, "z": z, "sigma": SIGMA, "tdoa": tdoa}, True)
    assert sum(proof == "global" for proof, *_ in certificates) >= TRIALS // 2
    for i, (proof, _, bound, *_) in enumerate(certificates):
        if proof == "global":
            assert bound <= minima(stations[i], z[i], tdoa[i], truth[i], rng).min() + 1e-6 * (1.0 + cost[i])


# Bounds and second derivatives of the node over boxes, in machine code and in plain Python, with a range beside it.
CHOICES = """
import numpy as np
import squared_range
from optloc.kernels.jit import plain
from optloc.proof.search_space import empty_box
from optloc.proof.curvature import curve_nodes
from optloc.proof.box import bound_nodes
from optloc.proof.nodes.dispatch import code_of, width

kinds = np.array([0, code_of(squared_range.SQUARED)])
rng = np.random.default_rng(5)

def asked(data, centre, sense, half):
    box = empty_box(2, 2)
    box.nodes[:] = box.curves[:] = 0.0
    bound_nodes(kinds, data, centre, sense, sense.T @ sense, half, box.line, box.nodes)
    second = np.zeros((3, 3))
    curve_nodes(kinds, data, centre, sense, sense.T @ sense, half, box.line, second, box.nodes, box.curves)
    return np.concatenate([box.nodes.ravel(), box.curves.ravel()])

for _ in range(50):
    data = np.zeros((2, width(kinds)))
    data[:, :3] = rng.uniform(-5e3, 5e3, (2, 3))
    box = rng.uniform(-8e3, 8e3, 3), 100.0 * rng.standard_normal((3, 3)), rng.uniform(0.1, 5.0, 3)
    ours = asked(data, *box)
    with plain():
        theirs = asked(data, *box)
    assert np.allclose(ours, theirs, rtol=1e-9, atol=1e-9), (ours, theirs)
    assert np.isfinite(ours).sum() > 20 and ours.any()
"""


@pytest.mark.slow
@pytest.mark.skipif(not enabled(), reason="without numba there is no machine code")
def test_machine_code_asks_the_same_of_a_node_from_outside():
    path = os.pathsep.join([str(HERE), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", CHOICES],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("d", [2, 3])
def test_the_node_of_the_example_is_bounded_in_every_sample(d):
    """What a package should test of its own node: no sample leaves the enclosure of its remainder."""
    rng = np.random.default_rng(3)
    for _ in range(50):
        line, sense, half, slope = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
        line[:d], half[:d] = rng.normal(size=d) * 1e3, rng.uniform(0.2, 1.0, d)
        sense[:d, :d] = rotation(rng, d)[:d, :d] * 10 ** rng.uniform(-1.0, 3.0, d)
        value, low, high = squared_range.bound(np.zeros(3), line, sense, half, slope)
        s = rng.uniform(-1.0, 1.0, (2000, 3)) * half
        rest = ((line + s @ sense.T) ** 2).sum(-1) - value - s @ slope
        assert rest.min() >= low - 1e-9 * value
        assert rest.max() <= high * (1.0 + 1e-9) + 1e-9 * value


def test_every_shipped_kind_names_what_it_is_made_of():
    assert all(code_of(node) < len(NODES) for model in MODELS.values() for _, node in model.nodes)
    assert all(model.ranges or model.nodes for model in MODELS.values())


def test_a_node_that_nobody_knows_is_named():
    with pytest.raises(InvalidProblem, match="azimut"):
        named("azimut")


def test_choices_are_written_from_the_table():
    """A longer table gives a longer function, and what no node answers is said of any code."""
    longer = [*NODES, squared_range.SQUARED]
    code = len(NODES)
    assert f"bound_{code}(own, line[:3], sense, half, slope)" in text_of("bound_others", longer)
    assert f"kind == {code}" not in text_of("bound_others", NODES)
    assert f"kind == {RANGE}:" not in text_of("bound_others", longer)
    assert text_of("shape_of", longer).rstrip().endswith("return 2")
