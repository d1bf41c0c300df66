"""Names that are no station's: one rule for mappings, series, data frames, arrays with names and files."""

import json

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from optloc import InvalidProblem, from_table, locate
from optloc.base.errors import nearest
from optloc.base.types import Stations, Status
from optloc.cli import app
from optloc.files import read
from optloc.files.convert import interpret_table
from optloc.files.table_import import ColumnHints

ANCHORS = {"A1": (0.0, 0.0), "A2": (10.0, 0.0), "A3": (10.0, 8.0), "A4": (0.0, 8.0), "A5": (5.0, -2.0)}
# The last one is 2 m short: it contradicts the others.
ERRORS = [0.02, -0.03, 0.01, 0.03, -2.0]
TAG = np.array([4.0, 3.0])
RANGES = {
    name: float(np.linalg.norm(TAG - np.array(place))) + e
    for (name, place), e in zip(ANCHORS.items(), ERRORS, strict=True)
}


def renamed(values, wrong, right="A5"):
    return {wrong if name == right else name: value for name, value in values.items()}


# In memory.

FORMS = {
    "mapping": lambda values: values,
    "series": pd.Series,
    "frame": lambda values: pd.DataFrame([values, values]),
    "frame in another order": lambda values: pd.DataFrame([values])[[*reversed(values)]],
    "long frame": lambda values: pd.DataFrame({"anchor": list(values), "range": list(values.values())}),
    "frame with epochs": lambda values: pd.DataFrame(
        {"epoch": [1] * len(values), "station": list(values), "value": list(values.values())}
    ),
    "structured array": lambda values: np.array([tuple(values.values())], dtype=[(name, float) for name in values]),
    "mapping of arrays": lambda values: {name: np.array([value, value]) for name, value in values.items()},
}


@pytest.mark.parametrize("form", FORMS)
def test_a_contradicting_anchor_is_a_misfit_in_every_form(form):
    fix = locate(ANCHORS, ranges=FORMS[form](RANGES), sigma=0.05).flat()
    assert {Status(code) for code in fix.code} == {Status.MISFIT}
    assert (fix.dof == 3).all()


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("wrong", "hint"), [("A5 ", "'A5'"), ("a5", "'A5'"), ("A55", "'A5'"), ("Anchor 5", "known are")]
)
def test_an_unknown_name_is_refused_in_every_form(form, wrong, hint):
    with pytest.raises(InvalidProblem) as raised:
        locate(ANCHORS, ranges=FORMS[form](renamed(RANGES, wrong)), sigma=0.05)
    assert f"there is no station {wrong!r}" in str(raised.value)
    assert hint in str(raised.value)


@pytest.mark.parametrize("extra", ["time", "note", "temperature_C", ("A1", "A2")])
def test_a_column_that_is_none_of_a_station_is_refused_with_advice_to_drop_it(extra):
    frame = pd.DataFrame([RANGES]).assign(x=[1.0]).rename(columns={"x": extra})
    with pytest.raises(InvalidProblem, match="drop columns without ranges"):
        locate(ANCHORS, ranges=frame, sigma=0.05)
    assert locate(ANCHORS, ranges=frame.drop(columns=[extra]), sigma=0.05).dof == 3


def test_times_of_rows_may_be_the_index():
    frame = pd.DataFrame([RANGES] * 2, index=pd.to_datetime(["2024-01-01", "2024-01-02"]))
    assert locate(ANCHORS, ranges=frame, sigma=0.05).dof.tolist() == [3, 3]


def test_a_frame_with_stations_as_rows_is_told_to_be_turned():
    frame = pd.DataFrame({"first": RANGES, "second": RANGES})
    with pytest.raises(InvalidProblem, match=r"give the transposed frame, \.T"):
        locate(ANCHORS, ranges=frame, sigma=0.05)
    assert locate(ANCHORS, ranges=frame.T, sigma=0.05).dof.tolist() == [3, 3]


def test_columns_of_pairs_are_read_and_refused_alike():
    far = {name: np.linalg.norm(TAG - np.array(place)) for name, place in ANCHORS.items()}
    pairs = {f"{name}-A1": far[name] - far["A1"] for name in ANCHORS if name != "A1"}
    fix = locate(ANCHORS, tdoa=pd.DataFrame([pairs]), unit="m", sigma=0.05)
    assert np.allclose(fix.position[0], TAG, atol=1e-6)
    assert fix.dof.tolist() == [2]
    tuples = pd.DataFrame([list(pairs.values())], columns=pd.MultiIndex.from_tuples([(n[:2], "A1") for n in pairs]))
    assert locate(ANCHORS, tdoa=tuples, unit="m", sigma=0.05).dof.tolist() == [2]
    with pytest.raises(InvalidProblem, match="there is no station 'A9-A1'"):
        locate(ANCHORS, tdoa=pd.DataFrame([pairs | {"A9-A1": 1.0}]), unit="m", sigma=0.05)


@pytest.mark.parametrize("word", ["bearings", "elevations", "pseudoranges", "toa"])
def test_all_kinds_have_the_rule(word):
    stations = {"Nord": (0.0, 0.0, 0.0), "Sued": (9e3, 1e3, 50.0), "West": (4e3, 8e3, 90.0), "Ost": (1e3, 5e3, 0.0)}
    values = dict.fromkeys(("Nord", "Sued", "West", "Ost", "West2"), 1.0)
    for given in (values, pd.Series(values), pd.DataFrame([values])):
        with pytest.raises(InvalidProblem, match="there is no station 'West2'; did you mean 'West'"):
            locate(stations, **{word: given}, sigma=1.0, height=0.0)


def test_columns_a_and_b_of_a_long_frame_are_none_of_stations_called_so():
    stations = {"a": (0.0, 0.0), "b": (900.0, 0.0), "c": (0.0, 800.0), "d": (900.0, 900.0)}
    far = {name: float(np.hypot(300.0 - x, 200.0 - y)) for name, (x, y) in stations.items()}
    frame = pd.DataFrame({"a": list("bcd"), "b": ["a"] * 3, "tdoa": [far[name] - far["a"] for name in "bcd"]})
    assert np.allclose(locate(stations, tdoa=frame, unit="m", sigma=1.0).position, [300.0, 200.0], atol=1e-3)


def test_the_nearest_name_is_that_without_blanks_and_case():
    assert nearest("a ", ["A", "B"]).startswith("did you mean 'A'?")
    assert nearest(" Lake", ["Mill", "lake"]).startswith("did you mean 'lake'?")
    assert nearest("Q", ["A", "B"]).startswith("known are")


# In files: a table with a column for each receiver.

STATIONS = "name,x_cm,y_cm\nA1,0,0\nA2,1000,0\nA3,1000,800\nA4,0,800\n"
CENTIMETRES = [502, 668, 783, 638]


def wide(folder, columns, values=None, **told):
    """Return the problem of a table with these columns, the first of which are those of known stations."""
    stations = folder / "anchors.csv"
    stations.write_text(told.pop("places", STATIONS))
    values = values or [*CENTIMETRES, *[310] * (len(columns) - 4)]
    lines = [",".join(["t_s", *columns]), *(",".join([str(row), *map(str, values)]) for row in range(3))]
    (folder / "table.csv").write_text("\n".join(lines) + "\n")
    return interpret_table(
        folder / "table.csv", ColumnHints(**({"stations": stations, "sigma": "5 cm", "what": "range"} | told))
    )


NAMED_ALIKE = {
    "before, unit": ([f"dist_A{i}_cm" for i in range(1, 6)], "A5", "dist_A5_cm"),
    "before, another unit": ([*(f"dist_A{i}_cm" for i in range(1, 5)), "dist_A5_m"], "A5", "dist_A5_m"),
    "before, without its unit": ([*(f"dist_A{i}_cm" for i in range(1, 5)), "dist_A5"], "A5", "dist_A5"),
    "another word, without its unit": ([*(f"dist_A{i}_cm" for i in range(1, 5)), "dist_Dam"], "Dam", "dist_Dam"),
    "behind": ([f"A{i} range [cm]" for i in range(1, 6)], "A5", "A5 range [cm]"),
    "name and unit": ([*(f"A{i}_cm" for i in range(1, 5)), "Mast_cm"], "Mast", "Mast_cm"),
    "name alone": ([*(f"A{i}" for i in range(1, 5)), "A7"], "A7", "A7"),
    "misspelt": ([*(f"A{i}" for i in range(1, 5)), "B1"], "B1", "B1"),
    "word around": ([f"anchor A{i}" for i in range(1, 6)], "A5", "anchor A5"),
}


@pytest.mark.parametrize("case", NAMED_ALIKE)
def test_a_receiver_that_is_no_station_is_refused(case, tmp_path):
    columns, name, column = NAMED_ALIKE[case]
    unit = {} if "cm" in columns[0] else {"unit": "cm"}
    with pytest.raises(InvalidProblem) as raised:
        wide(tmp_path, columns, **unit)
    said = str(raised.value)
    assert f"column {column!r}" in said
    assert f"there is no station {name!r}" in said
    assert "--ignore" in said
    made = wide(tmp_path, columns, **unit, ignore=(column,))
    assert len(made.sections[0].columns["z"]) == 12


@pytest.mark.parametrize(
    "column", ["rssi_A1", "temperature", "battery_V", "note", "x_m", "dist_sigma", "dist_A1_quality", "lat"]
)
def test_columns_of_other_things_are_no_receivers(column, tmp_path):
    made = wide(tmp_path, [*(f"dist_A{i}_cm" for i in range(1, 5)), column])
    assert len(made.sections[0].columns["z"]) == 12


def test_a_column_without_numbers_holds_no_readings(tmp_path):
    for cell in ("", "lost"):
        made = wide(tmp_path, [f"A{i}" for i in range(1, 6)], [*CENTIMETRES, cell], unit="cm")
        assert len(made.sections[0].columns["z"]) == 12


def test_words_as_names_are_refused_by_their_spelling(tmp_path):
    places = "name,x,y\nnorth,0,900\nsouth,0,-900\neast,900,0\nwest,-900,0\n"
    columns = ["north_m", "south_m", "east_m", "west_m", "wset_m"]
    with pytest.raises(InvalidProblem, match="there is no station 'wset'; did you mean 'west'"):
        wide(tmp_path, columns, places=places)


def test_pairs_with_an_unknown_end_are_refused(tmp_path):
    columns = ["A2-A1_cm", "A3-A1_cm", "A4-A1_cm", "A9-A1_cm"]
    with pytest.raises(InvalidProblem, match="there is no station 'A9'"):
        wide(tmp_path, columns, [166, 281, 136, 50], what="tdoa")


def test_fix_refuses_a_receiver_that_is_no_station_in_json_too(tmp_path):
    with pytest.raises(InvalidProblem):
        wide(tmp_path, [f"dist_A{i}_cm" for i in range(1, 6)])
    options = ["--stations", str(tmp_path / "anchors.csv"), "--sigma", "5 cm", "--as", "range", "--json"]
    found = CliRunner().invoke(app, ["fix", str(tmp_path / "table.csv"), *options])
    assert found.exit_code == 2
    assert "there is no station 'A5'" in found.stderr
    found = CliRunner().invoke(app, ["fix", str(tmp_path / "table.csv"), *options, "--ignore", "dist_A5_cm"])
    assert found.exit_code == 0
    assert len(json.loads(found.stdout)["fixes"]) == 3


@pytest.mark.parametrize("name", ["A5", "a1", "A 2", "A11"])
def test_rows_of_files_have_the_rule(name, tmp_path):
    (tmp_path / "anchors.csv").write_text(STATIONS)
    (tmp_path / "rows.csv").write_text(f"station,range_cm\nA1,502\nA2,668\nA3,783\n{name},638\n")
    told = ColumnHints(stations=tmp_path / "anchors.csv", sigma="5 cm")
    with pytest.raises(InvalidProblem, match=rf"row 4, column 'station': there is no station '{name}'"):
        interpret_table(tmp_path / "rows.csv", told)
    rows = "\n".join(f'  {{ a = "{each}", z = 5.0 }},' for each in ("A1", "A2", name))
    stations = '[stations]\nrows = [{name="A1",x=0,y=0},{name="A2",x=9,y=0},{name="A3",x=9,y=9}]\n'
    text = f'format = 2\n{stations}[[measurements]]\nkind = "range"\nsigma = "1 m"\nrows = [\n{rows}\n]\n'
    (tmp_path / "p.toml").write_text(text)
    with pytest.raises(InvalidProblem, match=rf"row 3, column 'a': there is no station '{name}'"):
        read(tmp_path / "p.toml")


@pytest.mark.parametrize("places", [(2, 4, 2), (3, 1, 4, 2)])
def test_stations_that_move_or_are_a_batch_are_refused_by_every_call(places):
    """A call that has no epochs cannot tell where such stations were."""
    stations = Stations(np.random.default_rng(2).uniform(0.0, 9.0, places), ("A", "B", "C", "D"))
    table = {"a": np.array(["A", "B", "C"]), "z": np.ones(3)}
    with pytest.raises(InvalidProblem, match="these stations move or are a batch"):
        locate(stations, ranges={"A": 5.0, "B": 6.0, "C": 5.0}, sigma=0.1)
    with pytest.raises(InvalidProblem, match="these stations move or are a batch"):
        from_table(table, stations, kind="range", sigma=0.1)


def test_names_of_rows_name_stations_of_a_frame_in_every_call():
    place = pd.DataFrame({"x": [0.0, 8.0, 0.0, 8.0], "y": [0.0, 0.0, 6.0, 6.0]}, index=["A", "B", "C", "D"])
    table = {"a": np.array(["A", "B", "C", "D"]), "z": np.full(4, 5.0)}
    assert from_table(table, place, kind="range", sigma=0.1).stations.names == ("A", "B", "C", "D")
    assert locate(place, ranges=dict.fromkeys("ABCD", 5.0), sigma=0.1).position == pytest.approx([4.0, 3.0])
