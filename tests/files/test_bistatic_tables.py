"""Tables of bistatic delays, of confidences, and of differences with rows of the reference station itself."""

import math
import re

import pytest

import optloc
from optloc import InvalidProblem
from optloc.files import load_table
from optloc.files.convert import interpret_table
from optloc.files.table_import import ColumnHints

STATIONS = {"R1": (0.0, 0.0), "R2": (10e3, 0.0), "R3": (0.0, 10e3), "T1": (-8e3, -9e3), "T2": (15e3, 12e3)}
TARGET = (4e3, 3e3)
LIGHT = 299_792_458.0
PATHS = (("R1", "T1"), ("R2", "T1"), ("R3", "T1"), ("R1", "T2"))


def excess(receiver, transmitter):
    """Return the path by way of the target minus the direct path, m."""
    a, b = STATIONS[receiver], STATIONS[transmitter]
    return math.dist(a, TARGET) + math.dist(b, TARGET) - math.dist(a, b)


def written(folder, text):
    """Return the path of a table; its stations are in the same folder."""
    rows = "".join(f"{name},{x},{y}\n" for name, (x, y) in STATIONS.items())
    (folder / "st.csv").write_text("name,x_m,y_m\n" + rows)
    (folder / "t.csv").write_text(text)
    return folder / "t.csv"


@pytest.mark.parametrize("column", ["tx", "transmitter", "illuminator"])
def test_delays_between_direct_and_reflected_path_are_sums_of_ranges(column, tmp_path):
    rows = "".join(f"{r},{t},{1e6 * excess(r, t) / LIGHT:.6f},0.1\n" for r, t in PATHS)
    path = written(tmp_path, f"rx,{column},bistatic_delay_us,confidence_us\n{rows}")
    found = interpret_table(path, ColumnHints(tmp_path / "st.csv"))
    assert found.sections[0].lines == ("excess = true",)
    assert ("sigma", "of range_sum, from column confidence_us") in found.about
    fix = optloc.solve(found.read().problem)
    assert fix.status.label == "ok"
    assert fix.position == pytest.approx(TARGET, abs=0.01)


def test_an_excess_path_in_metres_of_one_transmitter(tmp_path):
    rows = "".join(f"{r},{excess(r, 'T1'):.3f}\n" for r in ("R1", "R2", "R3"))
    path = written(tmp_path, f"rx,path\n{rows}")
    options = {"stations": tmp_path / "st.csv", "sigma": "30 m", "reference": "T1", "unit": "m"}
    problem = load_table(path, columns={"excess": "path"}, **options)
    direct = [math.dist(STATIONS[r], STATIONS["T1"]) for r in ("R1", "R2", "R3")]
    assert problem.z == pytest.approx([excess(r, "T1") + d for r, d in zip(("R1", "R2", "R3"), direct, strict=True)])


def test_a_confidence_without_a_unit_is_no_standard_deviation(tmp_path):
    path = written(tmp_path, "station,range_m,confidence\nR1,5000,0.9\nR2,6708,0.8\n")
    with pytest.raises(InvalidProblem, match="the accuracy of the rows is unknown"):
        interpret_table(path, ColumnHints(tmp_path / "st.csv"))
    path = written(tmp_path, "station,range_m,range_confidence_m\nR1,5000,10\nR2,6708,20\n")
    assert load_table(path, stations=tmp_path / "st.csv").count == 2


def differences(first="0"):
    """Return a table of differences to R1, with a row for R1 itself."""
    at = {name: math.dist(place, TARGET) for name, place in STATIONS.items()}
    rows = "".join(f"{name},{at[name] - at['R1']:.3f}\n" for name in ("R2", "R3", "T1", "T2"))
    return f"station,tdoa_m\nR1,{first}\n{rows}"


def test_zero_rows_of_the_reference_station_are_left_out_with_a_note(tmp_path):
    hints = ColumnHints(tmp_path / "st.csv", "1 m", reference="R1")
    found = interpret_table(written(tmp_path, differences()), hints)
    assert "zero readings of the reference station R1 to itself are left out: 1; see --reference" in found.notes
    assert optloc.solve(found.read().problem).position == pytest.approx(TARGET, abs=0.1)
    with pytest.raises(InvalidProblem, match="tdoa names station 'R1' twice; name two stations"):
        interpret_table(written(tmp_path, differences("3.5")), hints)


def test_a_column_of_the_reference_in_a_wide_table_is_left_out(tmp_path):
    at = {name: math.dist(place, TARGET) for name, place in STATIONS.items()}
    cells = ",".join(f"{value - at['R1']:.3f}" for value in at.values())
    path = written(tmp_path, ",".join(f"{name}_tdoa_m" for name in at) + f"\n{cells}\n{cells}\n")
    found = interpret_table(path, ColumnHints(tmp_path / "st.csv", "1 m", reference="R1"))
    assert "zero readings of the reference station R1 to itself are left out: 2; see --reference" in found.notes


def test_results_are_also_in_the_unit_of_the_stations(tmp_path):
    import csv
    import json

    from typer.testing import CliRunner

    from optloc.cli import app

    rows = "".join(f"{name},{100 * x},{100 * y}\n" for name, (x, y) in STATIONS.items())
    (tmp_path / "cm.csv").write_text("name,x_cm,y_cm\n" + rows)
    ranges = "".join(f"{name},{100 * math.dist(place, TARGET):.1f}\n" for name, place in STATIONS.items())
    (tmp_path / "t.csv").write_text("station,range_cm\n" + ranges)
    words = ["fix", str(tmp_path / "t.csv"), "--stations", str(tmp_path / "cm.csv"), "--sigma", "5 cm"]
    shown = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out.csv")])
    assert re.search(r"in cm +│ x = 400000 cm, y = 300000 cm", shown.stdout), shown.stdout
    fix = json.loads(CliRunner().invoke(app, [*words, "--json"]).stdout)["fixes"][0]
    assert [fix["x_cm"], fix["y_cm"]] == pytest.approx([4e5, 3e5], abs=1.0)
    assert [fix["x"], fix["y"]] == pytest.approx(TARGET, abs=0.01)
    with (tmp_path / "out.csv").open() as file:
        assert float(next(csv.DictReader(file))["x_cm"]) == pytest.approx(4e5, abs=1.0)
