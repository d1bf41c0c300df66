"""Tables of P and S picks: stations with P alone are kept, and all picks have one origin time."""

import numpy as np
import pytest
from picks_of_an_event import FOCUS, S_ALONE, picks, place, stations_csv

import optloc
from optloc import InvalidProblem
from optloc.files import load_table
from optloc.files.convert import interpret_table
from optloc.files.table_import import ColumnHints

# Stations and picks of the sample event of NonLinLoc, 1995-04-22 15:11 UTC: station, latitude, longitude, kilometres.
# Source: github.com/ut-beg-texnet/NonLinLoc, www_beta/nlloc_sample/original_output, vinti_nlloc_sample.in and
# vinti.19950422.151153. Its answer without REVF, whose residual is -0.84 s, is 43.794 N, 7.557 E, 10.7 km.
VINTI = """RONE,43.881333,7.598167,0.300
SBF,43.863500,7.434833,0.847
NEGI,43.847667,7.703833,0.640
REVF,43.740000,7.367500,0.700
AURF,43.887333,7.327500,1.040
AUTN,43.995500,7.427500,2.069
CEPP,43.916333,7.746500,1.080
MVIF,43.896500,7.152500,1.480
IMI,43.910500,7.893167,0.840
"""
P = {"RONE": 53.63, "SBF": 54.32, "NEGI": 54.13, "REVF": 53.87, "CEPP": 55.32, "AURF": 55.54, "AUTN": 56.03}
P |= {"IMI": 56.87, "MVIF": 57.64}
S = {"RONE": 55.70, "NEGI": 56.42, "CEPP": 58.34, "IMI": 60.85}
CRUST = "depth_km,vp_km_s,vs_km_s\n0,4.0,2.38\n2,6.0,3.57\n10,6.3,3.75\n18,7.0,4.17\n25,8.0,4.76\n"


@pytest.fixture
def vinti(tmp_path):
    """Return the path of the table of picks; its stations and its crust are in the same folder."""
    rows = [(name, "P", time) for name, time in P.items()] + [(name, "S", time) for name, time in S.items()]
    lines = "".join(f"{n},{w},1995-04-22T15:{11 + int(t // 60)}:{t % 60:05.2f}Z\n" for n, w, t in rows)
    (tmp_path / "picks.csv").write_text("station,phase,time\n" + lines)
    (tmp_path / "net.csv").write_text("station,lat,lon,elev_km\n" + VINTI)
    (tmp_path / "crust.csv").write_text(CRUST)
    return tmp_path / "picks.csv"


def solved(path, method="auto", **options):
    """Return the fix of a table of picks."""
    return optloc.solve(load_table(path, stations=path.parent / "net.csv", **options), method)


def test_nine_p_and_four_s_at_two_speeds(vinti):
    # own least squares of the thirteen arrivals at these speeds: 43.7553, 7.5496, 6.16 km, chi-square 11.599
    fix = solved(vinti, vp="6.0 km/s", vs="3.57 km/s", sigma="0.2 s")
    assert fix.latlon == pytest.approx([43.7553, 7.5496, -6164.0], abs=1.0)
    assert fix.latlon[:2] == pytest.approx([43.7553, 7.5496], abs=1e-4)
    assert fix.cost == pytest.approx(11.599, abs=1e-3)
    assert fix.certificate.proof == "global"


def test_nine_p_and_four_s_through_layers(vinti):
    # own layered least squares: 43.765, 7.553, 7.7 km
    fix = solved(vinti, vp=str(vinti.parent / "crust.csv"), sigma="0.2 s")
    assert fix.latlon[:2] == pytest.approx([43.765, 7.553], abs=1e-3)
    assert fix.latlon[2] == pytest.approx(-7.7e3, abs=150.0)
    found = interpret_table(vinti, ColumnHints(vinti.parent / "net.csv", "0.2 s", vp=str(vinti.parent / "crust.csv")))
    assert not any("left out" in note for note in found.notes)
    assert "vp / vs = 1.68" in dict(found.about)["waves"]


@pytest.mark.slow
def test_robust_finds_the_late_station(vinti):
    # NonLinLoc leaves REVF out: 43.794, 7.557, 10.7 km; own layered least squares without it 43.794, 7.555, 10.2 km
    fix = solved(vinti, "robust", vp=str(vinti.parent / "crust.csv"), sigma="0.1 s")
    assert fix.explanations[()][0].suspects[0].name == "station REVF"
    assert fix.latlon[:2] == pytest.approx([43.793, 7.555], abs=2e-3)
    assert fix.latlon[2] == pytest.approx(-10.2e3, abs=300.0)


def written(folder, text=None):
    """Return the path of simulated picks with P alone, both and S alone, or of another text."""
    lines = "".join(f"{name},{wave}g,{time.isoformat()}Z\n" for name, wave, time in picks())
    (folder / "net.csv").write_text(stations_csv())
    (folder / "picks.csv").write_text(text or "station,phase,time\n" + lines)
    return folder / "picks.csv"


def test_p_alone_both_and_s_alone_have_one_origin_time(tmp_path):
    problem = load_table(
        written(tmp_path), stations=tmp_path / "net.csv", vp="5.6 km/s", vs="3.2 km/s", sigma="p=0.02 s,s=0.05 s"
    )
    assert problem.count == len(picks())
    assert {rows.kind for rows in problem.rows} == {"toa", "range", "tdoa"}
    tdoa = next(rows for rows in problem.rows if rows.kind == "tdoa")
    assert problem.stations.names[int(tdoa.a[0])] == S_ALONE[0]
    fix = optloc.solve(problem)
    assert fix.status.label == "ok"
    assert np.linalg.norm(fix.position - place(*FOCUS)) < 60.0


def test_an_s_pick_that_no_row_contains_is_named(vinti):
    lines = vinti.read_text().splitlines()
    vinti.write_text("\n".join(line for line in lines if ",S," not in line or "RONE" in line or "IMI" in line) + "\n")
    hints = ColumnHints(vinti.parent / "net.csv", "0.2 s", vp="6.0 km/s", vs="3.57 km/s")
    assert not interpret_table(vinti, hints).read().warnings
    # without their P picks, no station has both
    lines = vinti.read_text().splitlines()
    vinti.write_text("\n".join(line for line in lines if not line.startswith(("RONE,P", "IMI,P"))) + "\n")
    (sentence,) = interpret_table(vinti, hints).read().warnings
    assert "1 S pick of RONE is not used" in sentence
    assert len(sentence) <= 200


def test_other_phases_are_left_out_with_a_note(tmp_path):
    path = written(tmp_path)
    path.write_text(path.read_text() + "AQU,Lg,2024-04-06T01:32:50Z\nAQU,SKS,2024-04-06T01:32:52Z\n")
    found = interpret_table(path, ColumnHints(tmp_path / "net.csv", "0.1 s", vp="5.6 km/s", vs="3.2 km/s"))
    assert "picks of other phases than P and S are left out: 2 (Lg, SKS); rename them if they are P or S" in found.notes


def test_p_alone_needs_no_speed_of_s(tmp_path):
    path = written(tmp_path)
    path.write_text("".join(line for line in path.read_text().splitlines(keepends=True) if ",Sg," not in line))
    fix = solved(path, vp="5.6 km/s", sigma="0.02 s")
    assert np.linalg.norm(fix.position - place(*FOCUS)) < 100.0


def test_s_minus_p_alone_is_a_choice(tmp_path):
    found = interpret_table(
        written(tmp_path), ColumnHints(tmp_path / "net.csv", "0.1 s", "sp", vp="5.6 km/s", vs="3.2 km/s")
    )
    assert [section.kind for section in found.sections] == ["range"]
    assert "4 stations without both P and S are left out; remove --as sp to use them" in found.notes


def test_the_written_file_gives_the_same_fix(tmp_path):
    from optloc.files.convert import convert

    path = written(tmp_path)
    options = {"stations": tmp_path / "net.csv", "vp": "5.6 km/s", "vs": "3.2 km/s", "sigma": "0.05 s"}
    made = convert(path, tmp_path / "event.toml", **options)
    assert "vp_vs = 1.7" in made.written[0].read_text()
    one, two = optloc.solve(load_table(path, **options)), optloc.solve(optloc.load(tmp_path / "event.toml"))
    assert one.position == pytest.approx(two.position, abs=1e-6)


def test_a_data_frame_of_picks_is_a_problem(tmp_path):
    pd = pytest.importorskip("pandas")
    net = pd.read_csv(written(tmp_path).parent / "net.csv").rename(columns={"station": "name"})
    net = net.rename(columns={"latitude": "lat_deg", "longitude": "lon_deg", "elevation_m": "height"})
    first = picks()[0][2]
    rows = [(name, wave, (time - first).total_seconds()) for name, wave, time in picks()]
    frame = pd.DataFrame(rows, columns=["a", "phase", "z"])
    problem = optloc.from_table(
        frame, net, kind="toa", unit="s", sigma="0.02 s", vp_vs=1.75, propagation_speed=5600.0, frame="geodetic",
        constraints=[{"kind": "height", "max": 1300.0}],
    )  # fmt: skip
    assert np.linalg.norm(optloc.solve(problem).position - place(*FOCUS)) < 100.0


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        (None, {"vp": None}, "the speeds of the P and S waves are unknown; state both, such as --vp '6 km/s'"),
        (None, {"vs": None}, "the speed of the S waves is unknown; state it; vp / 1.73 is 3237 m/s"),
        (None, {"sigma": "p=0.1 s"}, r"S picks have no sigma; write --sigma 'p=0.05 s,s=0.1 s'"),
        (None, {"sigma": None}, "the accuracy of the rows is unknown"),
        ("station,P_s,S_s\nAQU,3,2\n", {}, "row 1: the S wave is not after the P wave of station 'AQU'"),
        ("station,phase,time_s\nAQU,Lg,2\n", {}, "there are no P and S picks"),
        ("station,phase,time_s\nAQU,P,2\nAQU,P,3\n", {}, "has a second reading"),
    ],
)
def test_every_mistake_is_one_sentence(text, options, words, tmp_path):
    given = {"stations": tmp_path / "net.csv", "vp": "5.6 km/s", "vs": "3.2 km/s", "sigma": "0.1 s"} | options
    with pytest.raises(InvalidProblem, match=words) as error:
        load_table(written(tmp_path, text), **given)
    assert len(str(error.value)) <= 200


def test_load_table_names_an_unknown_option(tmp_path):
    with pytest.raises(InvalidProblem, match="there is no option 'sgma'; did you mean 'sigma'"):
        load_table(written(tmp_path), sgma="0.1 s")


def test_speeds_of_p_and_s_without_picks_are_refused(tmp_path):
    (tmp_path / "s.csv").write_text("name,x_m,y_m\nA,0,0\nB,900,0\nC,0,900\nD,900,1000\n")
    (tmp_path / "t.csv").write_text("station,toa_ms\nA,10\nB,20\nC,25\nD,30\n")
    hints = {"stations": tmp_path / "s.csv", "sigma": "1 ms"}
    with pytest.raises(InvalidProblem, match="--vp: the table has no picks of P and S"):
        interpret_table(tmp_path / "t.csv", ColumnHints(**hints, vp="5 km/s"))
    with pytest.raises(InvalidProblem, match="--unit: 'deg' is not a unit of"):
        interpret_table(tmp_path / "t.csv", ColumnHints(**hints, unit="deg"))
