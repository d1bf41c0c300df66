"""P and S arrivals in problem files: names of waves, and the keys and columns that they need."""

import pytest

import optloc
from optloc import InvalidProblem
from optloc.files.phase_rows import wave_of

FILE = """
format = 2
propagation_speed = 6000.0
[stations]
rows = [{ name = "A", x = 0.0, y = 0.0 }, { name = "B", x = 9e3, y = 0.0 }, { name = "C", x = 0.0, y = 9e3 }]
[[measurements]]
kind = "toa"
unit = "s"
sigma = "0.05 s"
vp_vs = 1.75
rows = [
  { a = "A", phase = "P", z = 1.83333 }, { a = "B", phase = "P", z = 1.97183 }, { a = "C", phase = "P", z = 2.20185 },
  { a = "A", phase = "S", z = 2.45833 },
]
"""


@pytest.mark.parametrize(
    ("phase", "wave"),
    [
        *((name, "P") for name in ("P", "p", "Pg", "Pn", "IPU0", "EP 1", "P1", "iPn")),
        *((name, "S") for name in ("S", "Sg", "ES", "Sn", "IS 2")),
        *((name, None) for name in ("PKP", "SKS", "Lg", "ScS", "PP", "AML", "", "END", "pick")),
    ],
)
def test_names_of_phases(phase, wave):
    assert wave_of(phase) == wave


def written(folder, old="", new=""):
    """Return the path of the file with one part replaced."""
    assert old in FILE
    (folder / "p.toml").write_text(FILE.replace(old, new))
    return folder / "p.toml"


def test_an_s_pick_makes_three_arrivals_in_the_plane_enough_for_a_test(tmp_path):
    fix = optloc.solve(optloc.load(written(tmp_path)))
    assert fix.position == pytest.approx([4e3, 3e3], abs=5.0)
    assert fix.dof == 1


def test_a_pick_of_weight_zero_is_absent(tmp_path):
    path = written(tmp_path, ", z =", ", weight = 1, z =")
    path.write_text(path.read_text().replace('"S", weight = 1', '"S", weight = 0'))
    assert optloc.load(path).count == 3
    path.write_text(path.read_text().replace('"S", weight = 0', '"S", weight = 0.5'))
    with pytest.raises(InvalidProblem, match="P and S arrivals need standard deviations, and weights of 0 or 1"):
        optloc.load(path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('kind = "toa"', 'kind = "range"', "vp_vs is for arrivals with a phase"),
        ('phase = "S"', 'phase = "Lg"', "row 4, .*the phase 'Lg' is neither P nor S; write P or S, or remove the row"),
        ('sigma = "0.05 s"', 'sigma = "estimate"', "P and S arrivals need a stated sigma"),
        ("vp_vs = 1.75", "vp_vs = 0.5", "vp_vs"),
    ],
)
def test_mistakes_are_one_sentence(old, new, words, tmp_path):
    with pytest.raises(InvalidProblem, match=words) as error:
        optloc.load(written(tmp_path, old, new))
    assert len(str(error.value)) <= 200


def test_simulated_arrivals_of_both_waves_are_refused(tmp_path):
    from optloc.files.writer import write_measured

    path = written(tmp_path)
    problem = optloc.load(path)
    with pytest.raises(InvalidProblem, match="simulated P and S arrivals cannot be written"):
        write_measured(path, tmp_path / "out.toml", problem.z[None])
