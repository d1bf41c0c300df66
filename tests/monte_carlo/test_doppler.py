"""Doppler fixes from nothing: what is proven, by how many boxes, and whether the best place was found."""

from collections import Counter
from time import process_time

import numpy as np
import pytest
from monte_carlo.tables import ledger
from proof.doppler import FAMILIES, SEED, Scenes, Trial, scenes_of
from scipy.stats import chi2

from optloc import Fix, Status, crlb, solve
from optloc.kernels.jit import enabled
from optloc.problem import ECEF
from optloc.solvers.policy import LISTED_GAP

SLACK, SAME = 1e-5, 1e-2
PASSES = "one pass of a satellite"
NINE = "passes of nine satellites"
SATELLITES = "three satellites, TDOA + FDOA"
# Fixes of a call; of mixtures each call has other kinds and stations.
BATCH = 6
FULL = dict.fromkeys(FAMILIES, 200)
FULL |= {name: 700 for name in FAMILIES if "bearing" in name} | {name: 250 for name in FAMILIES if "mixtures" in name}
FULL |= {PASSES: 2000, SATELLITES: 2000, NINE: 100}
# Descents from random places, beside the truth and the best dozen of a grid.
STARTS = 4
# Descents of each long run from random places alone.
_ANYWHERE = 10
METHODS = ("gtrs+lsr", "roots+lsr", "searched", "proven")
HEADER = [
    "rows",
    "fixes",
    "global",
    "unique",
    "`ok`",
    "others",
    "`ok`, cheaper position missed",
    "not `ok`, cheaper position missed",
    "boxes, median",
    "boxes, 99 %",
    "ms a fix (processor)",
    "also",
]


@pytest.fixture(scope="module")
def book(pytestconfig):
    facts, kept = f"seed {SEED}, margin {LISTED_GAP:g}, method auto", pytestconfig.cache.mkdir("optloc-tables")
    with ledger("doppler", HEADER, list(FAMILIES), facts, kept=kept) as made:
        yield made


class Counted:
    """What became of fixes of a family."""

    def __init__(self, name: str, trials: int, first: int = 1000) -> None:
        self.name, self.count, self.boxes, self.seconds, self.status = name, Counter(), [], 0.0, Counter()
        self.besides = Counter()
        for more in range(first, first + trials // BATCH):
            scenes = scenes_of(name, BATCH, 0, more)
            began = process_time()
            fix = solve(scenes.problem)
            self.seconds += process_time() - began
            best = cheapest(scenes, more)
            self.count["fixes"] += BATCH
            self.read(fix, best)
            BESIDES.get(name, _nothing)(self.besides, scenes, fix, best)

    def read(self, fix: Fix, best: np.ndarray) -> None:
        ok, beaten = fix.code == Status.OK, best < fix.cost - SLACK * (1.0 + np.abs(best))
        # where no place is answered, as at infinity, none is beaten
        beaten &= fix.answered
        proofs = fix.certificate
        self.boxes += [proof.boxes for proof in proofs if proof.proof == "global"]
        self.status += Counter(Status(int(code)).label for code in fix.code if code != Status.OK)
        found = {
            "global": [proof.proof == "global" for proof in proofs],
            "unique": [proof.unique for proof in proofs],
            "ok": ok,
            "wrong": ok & beaten,
            "missed": ~ok & beaten,
        }
        self.count.update({key: int(np.sum(values)) for key, values in found.items()})

    @property
    def cells(self) -> list[str]:
        """Return the cells of a row of the table."""
        others = ", ".join(f"{n} {label}" for label, n in self.status.most_common())
        n, boxes = self.count["fixes"], self.boxes or [0]
        return [
            str(n),
            *(str(self.count[key]) for key in ("global", "unique", "ok")),
            others,
            *(str(self.count[key]) for key in ("wrong", "missed")),
            f"{np.median(boxes):.0f}",
            f"{np.percentile(boxes, 99):.0f}",
            f"{1e3 * self.seconds / n:.0f}",
            SAID.get(self.name, lambda besides: "")(self.besides),
        ]


def cheapest(scenes: Scenes, more: int) -> np.ndarray:
    """Return the least costs (N,) that an independent search meets."""
    rng = np.random.default_rng([7, more])
    trials = [Trial(scenes, i) for i in range(len(scenes.truth))]
    return np.array([min(cost for _, cost, _ in trial.minima(rng, STARTS)) for trial in trials])


# What else is promised of some families.


def _nothing(besides: Counter, scenes: Scenes, fix: Fix, best: np.ndarray) -> None:
    """Count nothing more."""


def _by_any_method(besides: Counter, scenes: Scenes, fix: Fix, best: np.ndarray) -> None:
    """Count fixes that are `ok` by other methods, and those of them that something beats."""
    for method in METHODS:
        other = solve(scenes.problem, method)
        ok = other.code == Status.OK
        besides["ok"] += int(ok.sum())
        besides["wrong"] += int((ok & (best < other.cost - SLACK * (1.0 + best))).sum())


def _sides(besides: Counter, scenes: Scenes, fix: Fix, best: np.ndarray) -> None:
    """Count passes whose answer is the minimum next to the truth or that on the other side of the track."""
    for i in range(len(best)):
        trial = Trial(scenes, i)
        here, there = next_to_truth(trial), mirrored(trial)
        known = np.concatenate([fix.position[i : i + 1], fix.alternatives.x[i, :, :3]])
        at = [is_at(trial, known, x) for x in (here, there)]
        besides["either"] += bool(at[0][0] or at[1][0])
        if abs(trial.cost(here) - trial.cost(there)) < LISTED_GAP:
            besides["near"] += 1
            besides["listed"] += bool(at[0].any() and at[1].any())
        if not fix.answered[i]:
            continue
        stated, exact = stated_side(fix[i], here, there), exact_side(trial, here, there)
        besides["judged"] += 1
        besides["stated"] += (1.0 - stated) ** 2
        besides["exact"] += (1.0 - exact) ** 2


def next_to_truth(trial: Trial) -> np.ndarray:
    return trial.descended(trial.at_truth())[0]


def mirrored(trial: Trial) -> np.ndarray:
    """Return the minimum on the other side of the track, as it is over the turning Earth amid the pass.

    Of a weak pass the image may lie in the valley of the truth's own: places further aside are tried, too.
    """
    k, here = len(trial.a) // 2, next_to_truth(trial)
    normal = np.cross(trial.a[k], trial.v[k])
    normal /= np.linalg.norm(normal)
    for share in (2.0, 3.0, 4.0):
        image = here - share * (here @ normal) * normal
        there = trial.descended(np.array(ECEF.to_geodetic(image)[:2]))[0]
        if not is_at(trial, there[None], here)[0]:
            break
    return there


def is_at(trial: Trial, known: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return which places (q,) are a minimum, to a hundredth of a standard deviation."""
    with np.errstate(invalid="ignore"):
        return np.linalg.norm((known - x) @ trial.slope(x).T, axis=-1) < SAME


def stated_side(fix: Fix, here: np.ndarray, there: np.ndarray) -> float:
    """Return the probability of the truth's side of the track by the odds of the page: exp(gap / 2)."""
    known = np.concatenate([fix.position[None], fix.alternatives.x[:, :3]])
    odds = np.nan_to_num(np.exp(-0.5 * np.append(0.0, fix.alternatives.gap)))
    near = [np.nan_to_num(np.linalg.norm(known - x, axis=-1), nan=np.inf) for x in (here, there)]
    return float(odds[near[0] <= near[1]].sum() / odds.sum())


def exact_side(trial: Trial, here: np.ndarray, there: np.ndarray) -> float:
    """Return the posterior probability of the truth's side, every place of the Earth as likely before as any other."""
    least = min(trial.cost(here), trial.cost(there))
    ours, others = (volume(trial, x, least) for x in (here, there))
    return float(ours / (ours + others)) if np.linalg.norm(here - there) > 1.0 else 1.0


def volume(trial: Trial, x: np.ndarray, least: float) -> float:
    """Return the integral of the likelihood over the ground around a minimum, over that at a cost, square metres."""
    y = np.array(ECEF.to_geodetic(x)[:2])
    slope = trial.slope(x) @ trial.stretch(y)
    spread = np.linalg.cholesky(np.linalg.inv(slope.T @ slope))
    ticks = np.linspace(-8.0, 8.0, 65)
    around = y + np.stack(np.meshgrid(ticks, ticks, indexing="ij"), axis=-1) @ spread.T
    cell = np.linalg.det(spread) * (ticks[1] - ticks[0]) ** 2
    area = np.prod(np.linalg.norm(trial.stretch(y), axis=0)) * np.cos(around[..., 0]) / np.cos(y[0])
    return float((np.exp(-0.5 * (trial.cost(trial.to_place(around)) - least)) * area).sum() * cell)


def _against_bound(besides: Counter, scenes: Scenes, fix: Fix, best: np.ndarray) -> None:
    """Sum up squared errors along the ground, each over what its bound allows; count `ok` ellipses that hold the truth.

    Over its own bound: of sums over all, five scenes of two thousand would be a quarter.
    """
    bound, spread = crlb(scenes.problem, scenes.truth), fix.covariance()
    for i, truth in enumerate(scenes.truth):
        axes = ECEF.enu_axes(truth)[:2]
        error = axes @ (fix.position[i] - truth)
        if not fix.answered[i]:
            continue
        besides["judged"] += 1
        besides["squared"] += error @ error / np.trace(axes @ bound[i] @ axes.T)
        if fix.code[i] == Status.OK:
            besides["sure"] += 1
            squared = error @ np.linalg.solve(axes @ spread[i] @ axes.T, error)
            besides["covered"] += bool(squared < chi2.ppf(0.95, 2))


def _from_anywhere(besides: Counter, scenes: Scenes, fix: Fix, best: np.ndarray) -> None:
    """Count the descents from random places on Earth that end at the best place."""
    rng = np.random.default_rng(int(1e6 * scenes.truth[0, 0]) % 2**32)
    for i in range(len(scenes.truth)):
        trial = Trial(scenes, i)
        for start in trial.anywhere(rng, _ANYWHERE):
            besides["descents"] += 1
            besides["arrived"] += bool(trial.descended(start)[1] < best[i] + SLACK * (1.0 + best[i]))


def _said_of_descents(besides: Counter) -> str:
    return f"{besides['arrived']} of {besides['descents']} descents from random positions end at the best minimum"


def _said_of_sides(besides: Counter) -> str:
    n = max(besides["judged"], 1)
    stated, exact = (f"{besides[key] / n:.4f}" for key in ("stated", "exact"))
    scores = f"Brier score of the stated side {stated}, of the exact posterior {exact}"
    either = f"the fix is the truth or its mirror image: {besides['either']}"
    return f"{either}; the other is listed if its gap is below 25: {besides['listed']} of {besides['near']}; {scores}"


def _said_of_bound(besides: Counter) -> str:
    ratio, held = np.sqrt(besides["squared"] / besides["judged"]), besides["covered"] / max(besides["sure"], 1)
    return f"RMSE {ratio:.3f} of the bound; the 95 % ellipses of `ok` contain {100.0 * held:.1f} % of truths"


def _said_of_methods(besides: Counter) -> str:
    return f"{besides['ok']} `ok` by {len(METHODS)} other methods, a cheaper position known for {besides['wrong']}"


HYBRIDS = [name for name in FAMILIES if "bearing" in name]
BESIDES = {PASSES: _sides, NINE: _from_anywhere, SATELLITES: _against_bound, **dict.fromkeys(HYBRIDS, _by_any_method)}
SAID = {
    PASSES: _said_of_sides,
    NINE: _said_of_descents,
    SATELLITES: _said_of_bound,
    **dict.fromkeys(HYBRIDS, _said_of_methods),
}


def judge(made: Counted) -> None:
    """Fail where something is not as it is promised on the pages."""
    name, count, besides = made.name, made.count, made.besides
    assert count["wrong"] == 0
    assert besides["wrong"] == 0
    if name in ("moving pair, known offset", "four receivers in the plane"):
        assert count["global"] == count["fixes"]
    if name == PASSES:
        assert besides["either"] == count["fixes"]
        assert besides["listed"] == besides["near"]
        assert abs(besides["stated"] - besides["exact"]) < 0.01 * besides["judged"]
    if name == SATELLITES:
        n = besides["sure"]
        # Of n errors, most along one axis, the mean square is known to sqrt(2 / n), a share of 95 % to 0.22 / sqrt(n).
        assert abs(besides["squared"] / besides["judged"] - 1.0) < 0.1 + 4.3 / np.sqrt(n)
        assert abs(besides["covered"] / n - 0.95) < 0.02 + 0.65 / np.sqrt(n)


@pytest.mark.skipif(not enabled(), reason="budgets of boxes are smaller in plain Python")
@pytest.mark.parametrize("name", [PASSES, SATELLITES])
def test_passes_and_pairs_of_differences_are_as_promised(name, record_property):
    made = Counted(name, BATCH)
    record_property("counts", ", ".join(made.cells))
    judge(made)


@pytest.mark.full
@pytest.mark.parametrize("name", FAMILIES)
def test_doppler_in_full(name, book):
    if name in book.rows:  # of the same code, by a run that was stopped
        return
    made = Counted(name, FULL[name])
    judge(made)
    book.add(name, *made.cells)
