"""Speeds of P and S waves: two numbers, or layers with one ratio of both speeds."""

import pytest

from optloc import InvalidProblem
from optloc.files.crust import crust_of
from optloc.files.table_import import ColumnHints

LAYERS = "depth_km,vp_km_s,vs_km_s\n0,4.0,2.30\n2,6.0,3.50\n10,6.3,3.60\n"


def crust(folder, text=LAYERS, *, with_s=True, **options):
    """Return the crust of a table."""
    (folder / "crust.csv").write_text(text)
    return crust_of(ColumnHints(vp=str(folder / "crust.csv"), **options), with_s=with_s)


def test_two_speeds_are_a_speed_and_a_ratio():
    found = crust_of(ColumnHints(vp="6 km/s", vs="3500 m/s"), with_s=True)
    assert found.lines == ("propagation_speed = 6000.0",)
    assert found.vp_vs == pytest.approx(6 / 3.5)
    assert found.medium(1000.0) == ()


def test_the_first_layer_extends_to_the_highest_station(tmp_path):
    found = crust(tmp_path)
    assert found.lines == ()
    assert "depths = [0.0, 4200.0, 12200.0]" in found.medium(2069.0)
    assert "surface = 2200.0" in found.medium(2069.0)
    assert "speeds = [4000.0, 6000.0, 6300.0]" in found.medium(2069.0)
    assert found.vp_vs == pytest.approx((4 / 2.3 + 6 / 3.5 + 6.3 / 3.6) / 3)
    assert "vp / vs is 1.714 to 1.75, so P and S waves have separate rays" in found.note
    assert "s_speeds = [2300.0, 3500.0, 3600.0]" in found.medium(2069.0)
    assert found.ratio == '"layers"'


def test_an_equal_ratio_is_one_number(tmp_path):
    found = crust(tmp_path, "depth_km,vp_km_s,vs_km_s\n0,4.0,2.31\n2,6.0,3.47\n")
    assert not any("s_speeds" in line for line in found.medium(0.0))
    assert float(found.ratio) == pytest.approx(1.73, abs=0.002)


@pytest.mark.parametrize(
    "header", ["depth km,vp km/s,vs km/s", "Depth [km],Vp [km/s],Vs [km/s]", "depth_km,VP_km_s,VS_km_s"]
)
def test_spellings_of_units(header, tmp_path):
    assert crust(tmp_path, LAYERS.replace("depth_km,vp_km_s,vs_km_s", header)).speeds == (4000.0, 6000.0, 6300.0)


def test_a_stated_ratio_replaces_the_column(tmp_path):
    assert crust(tmp_path, vs="vp/1.78").vp_vs == 1.78
    assert crust(tmp_path, "depth_m,vp_m/s\n0,4000\n900,5000\n", with_s=False).vp_vs is None


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("depth_km,vp\n0,4\n", {}, "the unit of the column 'vp' is unknown; name it 'vp km/s'"),
        ("top_km,vp_km_s\n0,4\n", {}, "lack a depth or vp; name the columns 'depth km'"),
        ("depth_km,vp_km_s\n0,4\n", {}, "state the ratio of both speeds, such as --vs 'vp/1.73'"),
        ("depth_km,vp_km_s,vs_km_s\n0,4,5\n", {}, "P waves of 4000 m/s are not faster than S waves of 5000 m/s"),
        ("depth_km,vp_km_s,vs_km_s\n5,4,2\n0,5,3\n", {}, "depths must increase"),
        (LAYERS, {"vs": "3.5 km/s"}, "'3.5 km/s' is not a ratio of P to S in layers; write --vs 'vp/1.73'"),
    ],
)
def test_mistakes_are_one_sentence(text, options, words, tmp_path):
    with pytest.raises(InvalidProblem, match=words) as error:
        crust(tmp_path, text, **options)
    assert len(str(error.value)) <= 200


def test_a_speed_is_positive():
    with pytest.raises(InvalidProblem, match="--vp: the speed -1 km/s is not positive; write it as '6 km/s'"):
        crust_of(ColumnHints(vp="-1 km/s", vs="1 km/s"), with_s=True)
