"""The advice names the planted cause of random problems, if the data identify it, and names none for clean data."""

import json
import pickle
from dataclasses import asdict
from hashlib import blake2b
from pathlib import Path

import numpy as np
import pytest
from advice.judge import verdict
from advice.marks import CLEAN, PLANTED, Counts, Mark, false_alarms, mark_of, marked
from advice.planted import JUDGED, PAIRS, drawn
from advice.scene import loaded, predicted
from monte_carlo.tables import FOLDER, code_digest, ledger
from often import few

import optloc

FULL = 200
KEPT = FOLDER.parents[1] / "build" / "full"  # ignored by git; a run that was stopped goes on
HEADER = [
    "cause and kind",
    "draws",
    "identifiable",
    "first",
    "listed",
    "no cause given",
    "wrong cause alone",
    "of these identifiable",
    "right station alone, another error",
    "first instead",
]
CLEAN_HEADER = ["data without a mistake", "draws", "with a cause", "causes"]
_HERE = Path(__file__).parent
# Pairs of the default run, one for each way in which a cause enters.
SHORT = ["offset range", "unit tdoa", "anticlockwise azimuth", "swapped range", "sign tdoa", "moved range"]


@pytest.mark.parametrize("name", ["offset range", "outlier azel", "unit toa", "compass azimuth", "lat-lon tdoa"])
def test_the_file_of_a_draw_has_its_values(name, tmp_path):
    draw = drawn(name, JUDGED)
    problem = loaded(draw.data, tmp_path)
    assert problem.count == draw.data.z.size
    assert problem.stations.count == draw.data.stations
    lengths = np.concatenate([rows.z.ravel() for rows in problem.rows])
    expected = draw.data.z.ravel()
    if "azimuth" not in draw.data.kind:
        np.testing.assert_allclose(np.sort(lengths), np.sort(expected), rtol=1e-9)
    np.testing.assert_allclose(np.sort(problem.stations.places.ravel()), np.sort(draw.data.place.ravel()), rtol=1e-9)


@pytest.mark.parametrize("name", ["clean tdoa", "clean azel", "clean range_sum", "clean groa", "clean toa sky"])
def test_the_judge_has_the_costs_of_the_package(name, tmp_path):
    draw = drawn(name, JUDGED)
    fix = optloc.solve(loaded(draw.data, tmp_path))
    own = next(one.cost for one in verdict(draw).scores if one.cause == "none")
    assert own == pytest.approx(float(np.sum(fix.cost)), rel=1e-3, abs=1e-3)


def test_draws_are_clean_before_the_mistake():
    for name in ("offset range", "swapped range", "moved range"):
        draw = drawn(name, JUDGED)
        u = (draw.right.z - predicted(draw.right, draw.truth)) / draw.right.sigma
        assert (u**2).mean() < 3.0
        assert np.abs(draw.data.z - draw.right.z).sum() + np.abs(draw.data.place - draw.right.place).sum() > 0.0


@pytest.mark.parametrize("name", few(SHORT, 3))
def test_the_judge_finds_gross_mistakes(name):
    leads = [verdict(drawn(name, JUDGED + i)).lead for i in range(3)]
    assert max(leads) > 16.0


@pytest.fixture(scope="module")
def book():
    facts = f"seeds from {JUDGED}, {FULL} draws a pair; first, listed and no cause: of identifiable draws"
    with ledger("advice", HEADER, PLANTED, facts, kept=KEPT) as made:
        yield made


@pytest.fixture(scope="module")
def clean_book():
    with ledger("advice_clean", CLEAN_HEADER, CLEAN, f"seeds from {JUDGED}, {FULL} draws", kept=KEPT) as made:
        yield made


def judged(name, seed):
    """Return the scores of the judge of a draw, from the store of an earlier run of the same judge if it has them."""
    text = b"".join((_HERE / f"{part}.py").read_bytes() for part in ("planted", "scene", "judge"))
    folder = KEPT / f"verdicts-{blake2b(text, digest_size=8).hexdigest()}"
    file = folder / f"{name.replace(' ', '_')}-{seed}.pickle"
    if file.exists():
        return verdict(drawn(name, seed), pickle.loads(file.read_bytes()))
    found = verdict(drawn(name, seed))
    folder.mkdir(parents=True, exist_ok=True)
    file.write_bytes(pickle.dumps(found.scores))
    return found


def marks(name, tmp_path) -> list[Mark]:
    """Return the marks of all seeds of a pair; a run that was stopped goes on."""
    file = KEPT / f"advice-{code_digest(*_HERE.glob('*.py'))}" / f"{name.replace(' ', '_')}.jsonl"
    file.parent.mkdir(parents=True, exist_ok=True)
    made = [mark_of(json.loads(line)) for line in file.read_text().splitlines()] if file.exists() else []
    with file.open("a") as out:
        for seed in range(JUDGED + len(made), JUDGED + FULL):
            made.append(marked(name, seed, tmp_path, judged(name, seed)))
            out.write(json.dumps(asdict(made[-1])) + "\n")
            out.flush()
    return made


@pytest.mark.full
@pytest.mark.parametrize("name", PLANTED)
def test_planted_causes_in_full(name, tmp_path, book):
    book.add(name, *Counts.of(marks(name, tmp_path)).cells)


@pytest.mark.full
@pytest.mark.parametrize("name", CLEAN)
def test_clean_data_in_full(name, tmp_path, clean_book):
    alarms = false_alarms(marks(name, tmp_path))
    clean_book.add(name, FULL, sum(alarms.values()), ", ".join(f"{k} {v}" for k, v in alarms.most_common()))


def test_every_pair_has_a_scene():
    for name in PAIRS:
        draw = drawn(name, JUDGED)
        assert np.isfinite(draw.data.z).all()
        assert np.isfinite(draw.truth).all()
