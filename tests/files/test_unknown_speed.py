"""A speed with a standard deviation, in problem files and in `optloc.locate`."""

from pathlib import Path

import numpy as np
import pytest

from optloc import InvalidProblem, load, locate, solve
from optloc.files.writer import write_measured

RNG = np.random.default_rng(1)
PLACE = RNG.uniform(0.0, 10.0, (6, 2))
TRUTH = np.array([3.0, 4.0])
TIMES = np.linalg.norm(PLACE - TRUTH, axis=1) / 350.0 + 0.01 + 1e-5 * RNG.standard_normal(6)


def written(folder: Path, speed: str, more: str = "", unit: str = "ms") -> Path:
    """Return a problem file of arrivals whose speed is stated as text of TOML."""
    stations = "".join(f'  {{ name = "s{i}", x = {x!r}, y = {y!r} }},\n' for i, (x, y) in enumerate(PLACE.tolist()))
    values = TIMES * (1e3 if unit == "ms" else 343.0)
    rows = "".join(f'  {{ a = "s{i}", z = {z!r} }},\n' for i, z in enumerate(values.tolist()))
    path = folder / "speed.toml"
    path.write_text(
        f"format = 2\npropagation_speed = {speed}\n[stations]\nrows = [\n{stations}]\n"
        f'[[measurements]]\nkind = "toa"\nunit = "{unit}"\nsigma = 0.01\nrows = [\n{rows}]\n{more}'
    )
    return path


BIAS = '[[biases]]\nname = "speed"\nform = "scale"\nper = "kind"\nsigma = "{} 1"\n'


def test_a_speed_with_a_sigma_is_the_scale_that_it_stands_for(tmp_path):
    one = load(written(tmp_path, "{ value = 343.0, sigma = 5.0 }"))
    other = load(written(tmp_path, "343.0", BIAS.format(repr(5.0 / 343.0))))
    (bias,) = one.biases
    assert bias.sigma == pytest.approx([5.0 / 343.0])
    assert bias.members == ("343 m/s",)
    first, second = solve(one), solve(other)
    assert first.status.label == "ok"
    np.testing.assert_allclose(first.x, second.x, rtol=1e-9, atol=1e-9)
    true = 343.0 / (1.0 + first.bias["speed"][0])
    assert true == pytest.approx(350.0, abs=2.0)
    np.testing.assert_allclose(first.position, TRUTH, atol=0.02)


def test_units_of_the_speed_are_read(tmp_path):
    (bias,) = load(written(tmp_path, '{ value = "1234.8 km/h", sigma = "18 km/h" }')).biases
    assert bias.sigma == pytest.approx([5.0 / 343.0])


def test_the_speed_survives_writing(tmp_path):
    source = written(tmp_path, "{ value = 343.0, sigma = 5.0 }")
    before = load(source)
    out = tmp_path / "again.toml"
    write_measured(source, out, before.z[None])
    after = load(out)
    assert after.biases[0].sigma == pytest.approx(before.biases[0].sigma)
    np.testing.assert_allclose(after.z, before.z)
    assert solve(after).cost == pytest.approx(solve(before).cost)


@pytest.mark.parametrize(
    ("speed", "words"),
    [
        ("{ value = -343.0, sigma = 5.0 }", "not positive"),
        ("{ value = 0.0, sigma = 5.0 }", "not positive"),
        ("{ value = 343.0, sigma = 0.0 }", "not positive"),
        ("{ value = nan, sigma = 5.0 }", "not a finite number"),
        ("{ value = 343.0, sigma = nan }", "not a finite number"),
        ("{ value = 343.0 }", "the key 'sigma' is missing"),
        ("{ value = 343.0, sigma = 5.0, more = 1.0 }", "unknown key 'more'"),
        ("[343.0, 5.0, 1.0]", "does not fit"),
        ('{ value = 343.0, sigma = "5 kg" }', "kg"),
        ('{ medium = "ice", celsius = 1.0 }', "'ice' is unknown"),
    ],
)
def test_bad_speeds_of_files_are_refused(tmp_path, speed, words):
    with pytest.raises(InvalidProblem, match=r".") as told:
        load(written(tmp_path, speed))
    assert words in str(told.value)


@pytest.mark.parametrize(
    ("speed", "keys"),
    [
        ("{ value = 343.0, sigma = 5.0, typo = 1.0 }", "sigma, value"),
        ('{ medium = "air", celsius = 20.0, typo = 1.0 }', "celsius, depth, medium, salinity"),
    ],
)
def test_unknown_keys_of_a_speed_list_the_keys_of_its_table(tmp_path, speed, keys):
    with pytest.raises(InvalidProblem, match="unknown key 'typo'") as told:
        load(written(tmp_path, speed))
    assert keys in str(told.value)


def test_a_sigma_needs_times_and_no_second_scale(tmp_path):
    with pytest.raises(InvalidProblem, match="no measurement is a time"):
        load(written(tmp_path, "{ value = 343.0, sigma = 5.0 }", unit="m"))
    with pytest.raises(InvalidProblem, match="twice"):
        load(written(tmp_path, "{ value = 343.0, sigma = 5.0 }", BIAS.format(0.1)))


def test_locate_takes_a_speed_with_its_sigma():
    fix = locate(PLACE, toa=TIMES, sigma=1e-5, wave_speed=(343.0, 5.0))
    assert fix.status.label == "ok"
    assert fix.certificate.proof == "global"
    np.testing.assert_allclose(fix.position, TRUTH, atol=0.02)
    assert 343.0 / (1.0 + fix.bias["speed"][0]) == pytest.approx(350.0, abs=2.0)


@pytest.mark.parametrize("speed", [(343.0, 5.0, 1.0), (0.0, 5.0), (343.0, 0.0), (343.0, -5.0), (np.nan, 5.0), (343.0,)])
def test_bad_speeds_of_locate_are_refused(speed):
    with pytest.raises(InvalidProblem, match="speed"):
        locate(PLACE, toa=TIMES, sigma=1e-5, wave_speed=speed)


def test_locate_refuses_a_sigma_of_the_speed_for_lengths():
    with pytest.raises(InvalidProblem, match="no measurement is a time"):
        locate(PLACE, ranges=343.0 * TIMES, sigma=0.01, wave_speed=(343.0, 5.0))


def test_the_answer_shows_the_speed():
    text = str(locate(PLACE, toa=TIMES, sigma=1e-5, wave_speed=(343.0, 5.0)))
    line = next(line for line in text.splitlines() if line.startswith("speed") and "m/s" in line and "true" in line)
    assert "349.9" in line or "350" in line
