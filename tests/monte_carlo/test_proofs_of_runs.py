"""Runs of random fleets and of targets that move: how often they are proven, and whether anything refutes a proof."""

from collections import Counter
from contextlib import ExitStack
from dataclasses import replace
from time import process_time

import numpy as np
import pytest
from monte_carlo.tables import ledger
from proof.doppler import registration
from proof.runs.test_ground import drawn as over_ground
from proof.runs.test_state_bounds import drawn as moving_target, limits

from optloc import Problem, Status, simulate, solve
from optloc.kernels.jit import enabled
from optloc.kernels.least_squares import refine
from optloc.linear.constraints import exact, restore
from optloc.linear.vectors import vectors
from optloc.solvers.certificates.position_cost import state_columns

Array = np.ndarray
SEED, STARTS, BATCH = 20261123, 20, 4
EPOCHS = (10, 25, 60, 100, 200, 600)
CLOCKS = ("offsets", "offsets known to 20 m", "drifts")
MOVING = {"ranges": ("range",), "bearings": ("azimuth",), "range differences": ("tdoa",), "arrivals": ("toa",)}
# Epochs, clocks and seconds: ten minutes, and one.
RUNS = {f"{epochs} epochs, {clocks}": (epochs, clocks, 600.0) for epochs in EPOCHS for clocks in CLOCKS}
RUNS |= {f"25 epochs in a minute, {clocks}": (25, clocks, 60.0) for clocks in CLOCKS[:2]}
COURSES = {f"a target that moves, {words}": kinds for words, kinds in MOVING.items()}
GROUND = {f"at a known height, {words}": kinds for words, kinds in MOVING.items()}
# 20 cells of 112 runs are two thousand and some; of each kind of row of a moving target; of those over ground, whose
# refinements take a second.
FULL, FULL_MOVING, FULL_GROUND = 112, 200, 60
HEADER = ["runs", "fixes", "proven", "unique", "`ok`", "others", "refuted", "boxes, median", "boxes, 99 %", "ms a fix"]


TABLES = {"proofs_of_runs": [*RUNS, *COURSES], "proofs_over_ground": [*GROUND]}
COURSES |= GROUND


@pytest.fixture(scope="module")
def books(pytestconfig):
    facts = f"seed {SEED}, method auto, {STARTS} refinements against each"
    kept = pytestconfig.cache.mkdir("optloc-tables")
    with ExitStack() as stack:
        yield {
            file: stack.enter_context(ledger(file, HEADER, names, facts, kept=kept)) for file, names in TABLES.items()
        }


def fleets(epochs: int, clocks: str, span: float, number: int) -> tuple[Problem, Array]:
    """Return some runs of one fleet, in the plane or in space, and where their targets are (n, d)."""
    rng = np.random.default_rng([SEED, epochs, CLOCKS.index(clocks), int(span), number])
    scenes = registration(rng, BATCH, 2 + number % 2, epochs, drift=clocks == "drifts", span=span)
    problem = scenes.problem
    if "known" in clocks:
        known = [(bias, np.full(len(bias.members), 20.0)) for bias in problem.biases]
        problem = replace(problem, biases=tuple(replace(bias, mean=0.0 * to, sigma=to) for bias, to in known))
    return problem, scenes.truth


def course(name: str, number: int) -> tuple[Problem, Array]:
    """Return a target that moves in the plane or over ground, within limits that are stated, and its state."""
    kinds = COURSES[name]
    rng = np.random.default_rng([SEED, len(kinds[0]), number])
    if name in GROUND:
        made, truth = over_ground(rng, kinds)
        return simulate(made, truth=truth, seed=number).flat(), truth[None, :6]
    made, truth = moving_target(rng, kinds, out=rng.choice([1.0, 2.0]), constraints=limits())
    return simulate(made, truth=truth, seed=number).flat(), truth[None, :4]


def refuted(problem: Problem, fix, truth: Array, rng: np.random.Generator) -> int:
    """Return how many of the proofs of a flat batch something refutes, of refinements beside the truth and anywhere."""
    n, size = truth.shape
    far = np.abs(truth).max(0)
    shape = (n, STARTS // 2, size)
    near = truth[:, None] + far * 10.0 ** rng.uniform(-4.0, 0.0, (*shape[:2], 1)) * rng.normal(size=shape)
    anywhere = 3.0 * far * rng.uniform(-1.0, 1.0, shape)
    starts = np.concatenate([near, anywhere], axis=1)
    count, own = 0, state_columns(problem)
    for i in range(n):
        claim = fix.certificate[i]
        if claim is None or claim.proof not in ("global", "region"):
            continue
        part = problem.take(np.full(starts.shape[1], i))
        x = vectors(part, starts[i][:, None])[:, 0]
        face = exact(problem)
        done = refine(part, restore(part, face, x) if face else x, face=face)
        place, gap = done.x[:, own], done.cost - fix.cost[i]
        inside = np.isfinite(done.cost) & (done.status == Status.OK)
        if claim.region is not None:
            limited = place if len(claim.region[0]) == size else place[:, [0, 1, 3, 4]]
            inside &= ((limited >= claim.region[0]) & (limited <= claim.region[1])).all(-1)
        known = np.concatenate([fix.x[i : i + 1, own], fix.alternatives.x[i][:, own]])
        spread = np.sqrt(np.diag(fix.cov[i][own, own]))
        with np.errstate(invalid="ignore"):
            apart = np.nanmin(np.abs((place[:, None] - known) / spread).max(-1), axis=1)
        wrong = inside & (gap < -1e-5 * (1.0 + fix.cost[i]))
        wrong |= inside & (gap < claim.margin - 1e-3) & (apart > 0.1)
        count += bool(wrong.any())
    return count


class Told:
    """What became of runs."""

    def __init__(self) -> None:
        self.count, self.status, self.boxes, self.seconds = Counter(), Counter(), [], 0.0

    def add(self, problem: Problem, truth: Array, rng: np.random.Generator) -> None:
        began = process_time()
        fix = solve(problem)
        self.seconds += process_time() - began
        claims = [claim for claim in fix.certificate if claim is not None]
        proven = [claim for claim in claims if claim.proof in ("global", "region")]
        self.boxes += [claim.boxes for claim in claims]
        self.status += Counter(Status(int(code)).label for code in fix.code if code != Status.OK)
        self.count += Counter(
            fixes=len(fix.code),
            proven=len(proven),
            unique=sum(claim.unique for claim in proven),
            ok=int((fix.code == Status.OK).sum()),
            refuted=refuted(problem, fix, truth, rng),
        )

    @property
    def cells(self) -> list[str]:
        others = ", ".join(f"{n} {label}" for label, n in self.status.most_common())
        numbers = [str(self.count[key]) for key in ("fixes", "proven", "unique", "ok")]
        middle, most = np.percentile(self.boxes or [0], [50, 99])
        each = f"{1e3 * self.seconds / self.count['fixes']:.0f}"
        return [*numbers, others, str(self.count["refuted"]), f"{middle:.0f}", f"{most:.0f}", each]


def told(name: str, trials: int) -> Told:
    """Return what became of some runs of a row of the table."""
    out = Told()
    for number in range(trials // BATCH if name in RUNS else trials):
        problem, truth = fleets(*RUNS[name], number) if name in RUNS else course(name, number)
        out.add(problem, truth, np.random.default_rng([1, number]))
    return out


def judge(name: str, made: Told) -> None:
    """Fail where something is not as it is promised on the pages."""
    assert made.count["refuted"] == 0
    share = made.count["proven"] / made.count["fixes"]
    assert share >= (0.95 if name in RUNS and RUNS[name][0] >= 100 else 0.5), share


@pytest.mark.skipif(not enabled(), reason="runs are proven by machine code")
@pytest.mark.parametrize("name", ["25 epochs, offsets", "a target that moves, ranges", "at a known height, ranges"])
def test_runs_are_proven_and_nothing_refutes_them(name):
    judge(name, told(name, 2 if name in GROUND else 2 * BATCH))


@pytest.mark.full
@pytest.mark.parametrize("name", [*RUNS, *COURSES])
def test_proofs_of_runs_in_full(name, books):
    book = books["proofs_over_ground" if name in GROUND else "proofs_of_runs"]
    if name in book.rows:  # of the same code, by a run that was stopped
        return
    made = told(name, FULL if name in RUNS else FULL_GROUND if name in GROUND else FULL_MOVING)
    judge(name, made)
    book.add(name, *made.cells)
