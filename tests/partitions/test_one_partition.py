"""One partition to a table of fixes: the schema never changes, and no event is lost."""

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from partitions.scenes import SIGMA, STATIONS, arrivals, wide

from optloc import InvalidProblem, Stations, fix_table, locate
from optloc.partitions import fix_schema

EVENT = {"message": "event"}


def test_a_long_table_gives_a_fix_for_each_event():
    table, truth = arrivals(0, 30)
    fixes = fix_table(table, STATIONS, sigma=SIGMA)
    assert fixes["epoch"].tolist() == [str(i) for i in range(30)]
    assert (fixes["status"] == "ok").mean() > 0.9
    away = (fixes[["x", "y"]].to_numpy() - truth) / fixes[["sigma_x", "sigma_y"]].to_numpy()
    assert np.abs(away).max() < 5.0
    assert np.allclose(fixes["cov_xx"], fixes["sigma_x"] ** 2)
    assert fixes["dof"].eq(3).all()
    assert fixes["lat_deg"].isna().all()


def test_a_wide_table_agrees_with_locate_and_missing_receivers_are_nan():
    table, _ = wide(0, 8)
    table.iloc[2, 3] = np.nan
    table.iloc[5, 1:] = np.nan
    fixes = fix_table(table, STATIONS, sigma="5 m", columns=EVENT)
    values = table.drop(columns="event").to_numpy()
    for row in (0, 2, 7):
        fix = locate(STATIONS, ranges=values[row], sigma=5.0)
        assert np.allclose(fixes.loc[fixes["epoch"] == str(row), ["x", "y"]], fix.position)
    lost = fixes[fixes["epoch"] == "5"]
    assert lost["status"].tolist() == ["too few rows"]
    assert lost["reason"].tolist() == ["the event has no reading"]
    assert lost["x"].isna().all()
    assert (len(fixes), fixes["dof"].tolist()) == (8, [4, 4, 3, 4, 4, 4, 4, 0])


def test_a_table_of_arrow_gives_a_table_of_arrow():
    table, _ = arrivals(0, 4)
    found = fix_table(pa.Table.from_pandas(table), STATIONS, sigma=SIGMA)
    assert found.schema == fix_schema("arrow")
    known = fix_table(table, STATIONS, sigma=SIGMA)
    assert found["x"].to_pylist() == known["x"].tolist()
    assert found["z"].null_count == 4
    assert found["status"].to_pylist() == known["status"].tolist()


@pytest.mark.parametrize("rows", [0, 1, 6, 7])
def test_the_schema_of_every_partition_is_the_same(rows):
    fixes = fix_table(arrivals(0, 2)[0].iloc[:rows], STATIONS, sigma=SIGMA)
    assert list(fixes.columns) == list(fix_schema().columns)
    assert fixes.dtypes.equals(fix_schema().dtypes)
    assert len(fixes) == -(-rows // 6)


def test_a_partition_without_any_reading_keeps_its_events():
    table, _ = wide(0, 3)
    table.iloc[:, 1:] = np.nan
    fixes = fix_table(table, STATIONS, sigma="5 m", columns=EVENT)
    assert fixes["epoch"].tolist() == ["0", "1", "2"]
    assert set(fixes["status"]) == {"too few rows"}


def test_fixes_on_earth_have_latitudes():
    places = pd.DataFrame({"name": list("ABCD"), "lat": [47.0, 47.1, 47.0, 47.1], "lon": [11.0, 11.0, 11.1, 11.1]})
    table = pd.DataFrame(
        {
            "event": [1],
            **{f"bearing_{name}_deg": [angle] for name, angle in zip("ABCD", (34.4, 145.6, 325.6, 214.4), strict=True)},
        }
    )
    fixes = fix_table(table, places, sigma="2 deg", columns=EVENT)
    assert fixes["lat_deg"].between(46.9, 47.2).all()
    assert fixes["cov_ee"].notna().all()


def test_stations_in_all_forms_give_the_same_fixes(tmp_path):
    table, _ = arrivals(0, 3)
    places = pd.DataFrame([(name, *xy) for name, xy in STATIONS.items()], columns=["name", "x", "y"])
    places.to_csv(tmp_path / "sites.csv", index=False)
    known = fix_table(table, STATIONS, sigma=SIGMA)
    array = Stations(np.array([list(STATIONS.values())]), tuple(STATIONS))
    for stations in (places, tmp_path / "sites.csv", str(tmp_path / "sites.csv"), array):
        pd.testing.assert_frame_equal(fix_table(table, stations, sigma=SIGMA), known)
    inline = table.merge(places, left_on="station", right_on="name").drop(columns="name")
    found = fix_table(inline, sigma=SIGMA)
    assert np.allclose(found[["x", "y"]], known[["x", "y"]])


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"window": "0.1 s"}, "--window: each partition would begin with a new window"),
        ({"still": True}, "--still: a partition has many events"),
        ({"sigma": "estimate"}, "--sigma: each partition would have another sigma"),
        ({"sgima": "3 m"}, "there is no option 'sgima'; did you mean 'sigma'"),
    ],
)
def test_options_that_depend_on_other_events_are_refused(options, text):
    with pytest.raises(InvalidProblem, match=text):
        fix_table(arrivals(0, 2)[0], STATIONS, **{"sigma": SIGMA} | options)


def test_wrong_tables_are_refused_in_one_sentence():
    with pytest.raises(InvalidProblem, match="no column has the event of each reading"):
        fix_table(arrivals(0, 1)[0].drop(columns="message"), STATIONS, sigma=SIGMA)
    table, _ = arrivals(0, 2)
    with pytest.raises(InvalidProblem, match="stations: the stations have no names"):
        fix_table(table, np.array(list(STATIONS.values())), sigma=SIGMA)
    with pytest.raises(InvalidProblem, match="all events share an unknown"):
        fix_table(table, STATIONS, sigma=SIGMA, wave_speed="3e8+-5 m/s")


def test_constraints_are_texts_of_the_command_line():
    table, _ = arrivals(0, 2)
    fixes = fix_table(table, STATIONS, sigma=SIGMA, constraints=["box min=[-1e4,-1e4] max=[1e4,1e4]"])
    assert len(fixes) == 2
