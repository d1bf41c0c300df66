"""Each cause planted in simulated data is named, its lines mend the fix, and clean data are not accused."""

import re

import numpy as np
import pytest
from often import few
from scipy.stats import binom

import optloc
from optloc.advice.advising import advise_at
from optloc.files import load
from optloc.model_checks.score import FALSE_ALARM, candidates, score
from optloc.problem.bias import with_bias

PLACE = np.array([[0.0, 0.0], [9.0, 1.0], [8.0, 9.0], [1.0, 8.0], [5.0, 12.0], [-3.0, 4.0], [4.0, -5.0]]) * 1e3
HEIGHT = np.array([0.0, 2.0, 0.3, 1.5, 0.1, 0.7, 1.2]) * 1e3
NAMES = ("A", "B", "C", "D", "E", "F", "G")
TRUTH = np.array([4e3, 3e3])
NOISE = {"tdoa": 5.0, "range": 5.0, "azimuth": 0.005}


def document(kind, change=lambda z: z, *, keys="", seed=2, height=None, truth=TRUTH, epochs=1):
    """Return a problem file with simulated values that a change was made to: `change` maps (k, m) to (k, m)."""
    place = PLACE if height is None else np.concatenate([PLACE, height[:, None]], axis=1)
    pairs = optloc.models.MODELS[kind].stations == 2
    a = np.arange(int(pairs), len(place))
    rows = optloc.measured(kind, a=a, b=0 if pairs else None, sigma=NOISE[kind])
    z = optloc.simulate(optloc.assemble(place, rows), truth=np.broadcast_to(truth, (epochs, len(truth))), seed=seed).z
    z = change(z)
    stations = ", ".join(
        f'{{ name = "{n}", ' + ", ".join(f"{c} = {v}" for c, v in zip("xyz", p, strict=False)) + " }"
        for n, p in zip(NAMES, place, strict=True)
    )
    ends = [f'a = "{NAMES[i]}"' + (', b = "A"' if pairs else "") for i in a]
    when = [f", time = {10.0 * k}" if epochs > 1 else "" for k in range(epochs)]
    lines = ",\n".join(
        f"{{ {end}, z = {float(v)!r}{when[k]} }}" for k in range(epochs) for end, v in zip(ends, z[k], strict=True)
    )
    target = '[target]\nmotion = "static"\n' if epochs > 1 else ""
    head = f'format = 1\n{target}[stations]\nrows = [{stations}]\n[[measurements]]\nkind = "{kind}"\n'
    size = NOISE[kind] if "sigma" not in keys else None
    return (
        head
        + (f'sigma = "{size} {"rad" if kind == "azimuth" else "m"}"\n' if size else "")
        + f"{keys}rows = [{lines}]\n"
    )


def mended(text, advice):
    """Return a problem file with the lines of an advice: tables at its end, keys among those of its measurements."""
    if advice.toml.startswith("[["):
        return text + advice.toml
    keys = re.findall(r"^(\w+) =", advice.toml, re.MULTILINE)
    kept = re.sub(rf"^({'|'.join(keys)}) = .*\n", "", text, flags=re.MULTILINE)
    return kept.replace("[[measurements]]\n", f"[[measurements]]\n{advice.toml}")


def read(tmp_path, text):
    path = tmp_path / "site.toml"
    path.write_text(text)
    return load(path)


def at(i, amount, count=6):
    return amount * (np.arange(count) == i)


# What is planted, and what is to be named: cause, words of the sentence.
PLANTED = {
    "offset of a station": (document("tdoa", lambda z: z + at(2, 300.0)), "offset", "station D"),
    "offset of a range": (document("range", lambda z: z + at(4, 3000.0, 7)), "offset", "station E"),
    "offset of all ranges": (document("range", lambda z: z + 200.0), "offset", "all range rows"),
    "scale of all ranges": (document("range", lambda z: z * 1.02), "speed", "multiplied by 0.98"),
    "bearings turned together": (document("azimuth", lambda z: z + 0.1), "declination", "all azimuths"),
    "one antenna turned": (document("azimuth", lambda z: z + at(2, 0.2, 7)), "offset", "station C"),
    "compass": (document("azimuth", lambda z: np.pi / 2 - z), "compass", "compass bearings"),
    "bearings that look back": (document("azimuth", lambda z: z + np.pi), "opposite", "half a turn"),
    "degrees": (document("azimuth", np.degrees), "unit", "in deg instead of the stated rad"),
    "compass in degrees": (document("azimuth", lambda z: np.degrees(np.pi / 2 - z)), "compass", "in degrees"),
    "sign": (document("tdoa", lambda z: -z), "sign", "opposite sign"),
    "nanoseconds": (document("tdoa", lambda z: z / 0.299792458), "unit", "in ns instead of the stated m"),
    "kilometres": (document("range", lambda z: z * 1e-3), "unit", "in km instead of the stated m"),
    "seconds": (document("tdoa", lambda z: z / 299792458.0), "unit", "in s instead of the stated m"),
    "wrong prefix": (
        document("range", lambda z: z / 0.299792458e3, keys='unit = "m"\n'),
        "unit",
        "in us instead of the stated m",
    ),
    "drift of a clock": (
        document("tdoa", lambda z: z + np.arange(len(z))[:, None] * at(1, 30.0), epochs=9),
        "drift",
        "station C",
    ),
}


@pytest.mark.parametrize("name", few(PLANTED, 8))
def test_a_planted_cause_is_named_and_its_lines_mend_the_fix(tmp_path, name):
    text, cause, words = PLANTED[name]
    problem = read(tmp_path, text)
    fix = optloc.solve(problem, "gtrs+lsr" if problem.epochs == 1 else "auto")
    assert not fix.p_value >= FALSE_ALARM
    advice = optloc.advice.advise(problem, fix)[0]
    assert (advice.cause, words in advice.seen) == (cause, True), advice
    assert optloc.solve(read(tmp_path, mended(text, advice)), "auto").p_value >= FALSE_ALARM


def test_the_size_of_an_error_is_told_within_its_sigma(tmp_path):
    problem = read(tmp_path, document("tdoa", lambda z: z + at(2, 300.0)))
    (advice,) = optloc.advice.advise(problem)  # without a fix
    value, sigma = map(float, re.search(r"of ([-+.\d]+) ± ([.\d]+) m", advice.seen).groups())
    assert abs(value - 300.0) < 4.0 * sigma < 60.0


def test_a_step_in_a_run_is_named_with_its_time(tmp_path):
    late = np.arange(10)[:, None] >= 6
    problem = read(tmp_path, document("tdoa", lambda z: z + late * at(3, 200.0), epochs=10))
    advice = optloc.advice.advise(problem, optloc.solve(problem))[0]
    assert advice.cause == "step"
    assert "station E" in advice.seen
    assert "from t = 60 s on" in advice.seen


def test_epochs_that_share_nothing_are_looked_at_together(tmp_path):
    text = document("tdoa", lambda z: z + at(2, 40.0), epochs=8).replace('[target]\nmotion = "static"\n', "")
    problem = read(tmp_path, text)
    fix = optloc.solve(problem)
    assert fix.shape == (8,)
    advice = optloc.advice.advise(problem, fix)[0]
    assert advice.cause == "offset"
    assert "station D" in advice.seen


def test_a_boresight_of_azimuth_and_elevation_is_a_turn():
    place = np.concatenate([PLACE, HEIGHT[:, None]], axis=1)
    index, epoch = np.tile(np.arange(7), 4), np.repeat(np.arange(4), 7)
    rows = [optloc.measured(kind, a=index, epoch=epoch, sigma=0.002) for kind in ("azimuth", "elevation")]
    moving = (optloc.Motion(order=1),)
    template = optloc.assemble(place, *rows, times=[0.0, 20.0, 40.0, 60.0], motions=moving)
    turned = with_bias(template, "turn", form="rotation", members=[template.stations.names[3]])
    truth = np.concatenate([[4e3, -2e3, 4e3, 80.0, 150.0, 10.0], [0.05, -0.08, 0.02]])
    problem = template.with_rows(z=optloc.simulate(turned, truth=truth, seed=3).z)
    advice = optloc.advice.advise(problem, optloc.solve(problem))[0]
    assert advice.cause == "rotation"
    assert template.stations.names[3] in advice.toml


# Geometry.


def test_a_plane_of_stations_is_named_and_a_side_makes_the_fix_unique(tmp_path):
    text = document("range", height=1e-3 * HEIGHT, truth=np.array([4e3, 3e3, 5e3]))
    problem = read(tmp_path, text)
    fix = optloc.solve(problem)
    assert fix.status == optloc.Status.AMBIGUOUS
    (advice,) = optloc.advice.advise(problem, fix)
    assert advice.cause == "plane"
    better = optloc.solve(read(tmp_path, mended(text, advice)))
    assert not better.has(optloc.Status.AMBIGUOUS)
    assert abs(better.position[2] - 5e3) < 100.0


def test_stations_off_their_plane_whose_mirror_image_fits_all_the_same():
    place = np.concatenate([PLACE, 0.01 * HEIGHT[:, None]], axis=1)
    template = optloc.assemble(place, optloc.measured("range", a=np.arange(7), sigma=5.0))
    problem = optloc.simulate(template, truth=[4e3, 3e3, 0.5e3], seed=1)
    assert [one.cause for one in optloc.advice.advise(problem, optloc.solve(problem))] == ["mirror"]


def test_a_line_of_stations_is_named():
    place = np.arange(6)[:, None] * [1e3, 2e3, 0.0]
    template = optloc.assemble(place, optloc.measured("range", a=np.arange(6), sigma=5.0))
    problem = optloc.simulate(template, truth=[4e3, 3e3, 5e3], seed=1)
    assert [one.cause for one in optloc.advice.advise(problem)] == ["line"]


@pytest.mark.parametrize(("count", "word"), [(2, "fewer than unknowns"), (3, "no redundancy"), (4, "redundancy of 1")])
def test_redundancy_is_counted(count, word):
    template = optloc.assemble(PLACE[:count], optloc.measured("tdoa", a=np.arange(1, count), b=0, sigma=5.0))
    advice = optloc.advice.advise(optloc.simulate(template, truth=TRUTH, seed=1))
    assert any(one.cause == "redundancy" and word in one.seen for one in advice)


def test_a_file_without_values_has_geometry_alone():
    template = optloc.assemble(PLACE[:4], optloc.measured("tdoa", a=np.arange(1, 4), b=0, sigma=5.0))
    assert [one.cause for one in optloc.advice.advise(template)] == ["redundancy"]


def test_a_difference_beyond_the_distance_of_its_stations_is_impossible():
    template = optloc.assemble(PLACE, optloc.measured("tdoa", a=np.arange(1, 7), b=0, sigma=5.0))
    problem = optloc.simulate(template, truth=TRUTH, seed=1)
    wrong = problem.z + at(0, 1.5e4) - at(1, 1.2e4) + at(2, 1.3e4) - at(3, 1.6e4)
    advice = optloc.advice.advise(problem.with_rows(z=wrong))
    assert advice[0].cause in ("size", "impossible")


def test_a_constraint_that_the_data_contradict_is_named():
    place = np.concatenate([PLACE, HEIGHT[:, None]], axis=1)
    bounds = optloc.constraints.box([-np.inf, -np.inf, 200.0], [np.inf, np.inf, 200.0])
    template = optloc.assemble(place, optloc.measured("range", a=np.arange(7), sigma=5.0), constraints=bounds)
    problem = optloc.simulate(template, truth=[4e3, 3e3, 5e3], seed=1)
    advice = optloc.advice.advise(problem, optloc.solve(problem))
    assert advice[0].cause == "height"
    assert "p = 0." in advice[0].seen


# Nobody is accused without reason.


@pytest.mark.parametrize(("kind", "trials"), few([("tdoa", 40), ("tdoa", 200), ("range", 200), ("azimuth", 200)], 1, 2))
def test_clean_data_are_not_accused(kind, trials):
    pairs = optloc.models.MODELS[kind].stations == 2
    rows = optloc.measured(kind, a=np.arange(int(pairs), 7), b=0 if pairs else None, sigma=NOISE[kind])
    rng = np.random.default_rng(7)
    truths = rng.uniform(-2e3, 9e3, (trials, 2))
    problem = optloc.simulate(optloc.assemble(PLACE, rows), truth=truths, seed=8)
    told = [one for i in range(trials) for one in advise_at(problem.take(np.array([i])), truths[i])]
    assert len(told) <= binom.isf(1e-3, trials, FALSE_ALARM), told


def test_the_statistic_is_chi_square_for_clean_data():
    rows = optloc.measured("range", a=np.arange(7), sigma=5.0)
    problem = optloc.simulate(optloc.assemble(PLACE, rows), truth=np.broadcast_to(TRUTH, (150, 2)), seed=9)
    fix = optloc.solve(problem, "gtrs+lsr")
    found = candidates(problem.take(np.array([0])))
    values = [[t for t, _, _ in score(problem.take(np.array([i])), fix.x[[i]], found)] for i in range(150)]
    # a mean of 150 chi-squares of one degree has a standard deviation of sqrt(2 / 150) = 0.115; 15 means are looked at
    assert np.abs(np.mean(values, axis=0) - 1.0).max() < 4.0 * 0.115


def test_a_batch_gets_advice_for_each():
    rows = optloc.measured("range", a=np.arange(7), sigma=5.0)
    problem = optloc.simulate(optloc.assemble(PLACE, rows), truth=np.broadcast_to(TRUTH, (3, 2)), seed=9)
    problem = problem.with_rows(z=problem.z + np.array([0.0, 500.0, 0.0])[:, None] * at(2, 1.0, 7))
    advice = optloc.advice.advise(problem, optloc.solve(problem))
    assert [len(each) for each in advice] == [0, 1, 0]
    assert "S2" in advice[1][0].toml


def test_a_fix_of_another_problem_is_refused():
    rows = optloc.measured("range", a=np.arange(7), sigma=5.0)
    problem = optloc.simulate(optloc.assemble(PLACE, rows), truth=TRUTH, seed=9)
    other = optloc.simulate(optloc.assemble(PLACE, rows), truth=np.broadcast_to(TRUTH, (3, 2)), seed=9)
    with pytest.raises(optloc.InvalidProblem, match="fix"):
        optloc.advice.advise(problem, optloc.solve(other))
