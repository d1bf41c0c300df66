"""Foreign tables as problem files: what is read, what is asked for, and which row is to blame."""

import json

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from optloc import InvalidProblem, Status, solve
from optloc.base.frames import ECEF, Frame
from optloc.base.units import SPEED_OF_LIGHT
from optloc.cli import app
from optloc.files import read
from optloc.files.convert import convert
from optloc.lab import datasets
from optloc.problem import by_epoch

RUN = CliRunner()
SITES = {"A": (11.00, 47.00, 500.0), "B": (11.10, 47.02, 620.0), "C": (11.05, 47.10, 560.0), "D": (10.95, 47.08, 900.0)}
SITES |= {"E": (11.02, 46.95, 450.0)}
TRUTH = {"1": (11.03, 47.05, 3000.0), "2": (11.07, 47.01, 2500.0)}
# An instant of today: a float of its seconds keeps 0.2 us, which is 70 m.
NOW = 1_790_000_000


def place(lon, lat, height):
    return ECEF.from_geodetic(np.radians(lat), np.radians(lon), height)


def geojson(folder, sites=SITES):
    points = [
        {"type": "Feature", "properties": {"name": name}, "geometry": {"type": "Point", "coordinates": list(point)}}
        for name, point in sites.items()
    ]
    road = {"type": "Feature", "properties": {}, "geometry": {"type": "LineString", "coordinates": [[0, 0], [1, 1]]}}
    path = folder / "sites.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [*points, road]}))
    return path


def clock(there, at):
    """Return the fraction of a second, in picoseconds, at which a signal arrives."""
    return round(1e12 * (0.25 + np.linalg.norm(place(*there) - place(*at)) / SPEED_OF_LIGHT))


def arrivals(folder, message="message", station="station", time="toa_s", separator=",", suffix="csv"):
    rows = [
        (m, name, f"{NOW + int(m)}.{clock(there, at):012d}") for m, there in TRUTH.items() for name, at in SITES.items()
    ]
    table = pd.DataFrame(rows, columns=[message, station, time])
    path = folder / f"arrivals.{suffix}"
    table.to_csv(path, sep=separator, index=False) if suffix == "csv" else table.to_parquet(path)
    return path


def fixed(path):
    loaded = read(path)
    fix = solve(by_epoch(loaded.problem))
    off = [np.linalg.norm(p - place(*TRUTH[label])) for p, label in zip(fix.position, loaded.epochs, strict=True)]
    return fix, np.array(off)


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_arrival_times_keep_all_their_digits(suffix, tmp_path):
    out = tmp_path / "site.toml"
    found = convert(arrivals(tmp_path, suffix=suffix), out, stations=geojson(tmp_path), sigma="10 ns")
    assert [p.name for p in found.written] == ["site.toml", "site-stations.csv", "site-rows.csv"]
    fix, off = fixed(out)
    assert (fix.code == Status.OK).all()
    assert off.max() < 0.05
    assert (fix.cost < 1e-3).all()


def test_other_names_and_separators_are_told(tmp_path):
    source = arrivals(tmp_path, message="Pulse", station="RX", time="when [s]", separator=";")
    out = tmp_path / "site.toml"
    with pytest.raises(InvalidProblem, match=r"arrivals\.csv: the columns Pulse, RX, when \[s\] do not identify"):
        convert(source, out, stations=geojson(tmp_path), sigma="10 ns")
    convert(source, out, stations=geojson(tmp_path), sigma="10 ns", columns={"time": "when [s]"})
    assert fixed(out)[1].max() < 0.05


def test_several_columns_make_a_message(tmp_path):
    source = arrivals(tmp_path)
    table = pd.read_csv(source, dtype=str)
    table.assign(message="7", set=table["message"]).to_csv(source, index=False)
    out = tmp_path / "site.toml"
    with pytest.raises(InvalidProblem, match=r"row 6: .*'A' has a second .* '7', first in row 1; 5 repeats .*ONE\+TWO"):
        convert(source, out, stations=geojson(tmp_path), sigma="10 ns")
    found = convert(source, out, stations=geojson(tmp_path), sigma="10 ns", columns={"message": "set+message"})
    assert found.loaded.epochs == ("1-7", "2-7")


def test_stations_from_a_table_in_a_plane(tmp_path):
    frame = Frame.enu(lat_deg=47.0, lon_deg=11.0, height=0.0)
    rows = [(name, *frame.from_ecef(place(*at)) / 1e3) for name, at in SITES.items()]
    sites = tmp_path / "rx.csv"
    pd.DataFrame(rows, columns=["Receiver", "X_km", "Y_km", "Z_km"]).to_csv(sites, index=False)
    out = tmp_path / "site.toml"
    convert(arrivals(tmp_path), out, stations=sites, sigma="10 ns")
    position = solve(by_epoch(read(out).problem)).position
    assert np.linalg.norm(position - [frame.from_ecef(place(*p)) for p in TRUTH.values()], axis=-1).max() < 0.05


def test_stations_alone_are_a_table(tmp_path):
    out = tmp_path / "stations.csv"
    found = convert(geojson(tmp_path), out)
    assert (found.loaded, found.notes) == (None, ())
    table = pd.read_csv(out)
    assert table["name"].tolist() == list(SITES)
    np.testing.assert_allclose(table[["lon_deg", "lat_deg", "height"]], list(SITES.values()))
    flat = convert(geojson(tmp_path, {name: at[:2] for name, at in SITES.items()}), out)
    assert "no heights are given" in flat.notes[0]


def test_a_column_without_a_unit_is_asked_for_it(tmp_path):
    source, sites, out = arrivals(tmp_path, time="time"), geojson(tmp_path), tmp_path / "s.toml"
    with pytest.raises(InvalidProblem, match="the unit of the column 'time' is unknown; state it with --unit ns"):
        convert(source, out, stations=sites, sigma="10 ns")
    assert not convert(source, out, stations=sites, sigma="10 ns", unit="s").notes


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"station": {2: "Q"}}, r"row 3, column 'station': there is no station 'Q' in sites\.geojson"),
        ({"toa_s": {4: "soon"}}, "row 5, column 'toa_s': 'soon' is not a finite number"),
        ({"message": {1: None}}, "row 2, column 'message': the cell is empty"),
    ],
)
def test_a_bad_cell_is_named(change, words, tmp_path):
    source = arrivals(tmp_path)
    table = pd.read_csv(source, dtype=str)
    for column, cells in change.items():
        for row, value in cells.items():
            table.loc[row, column] = value
    table.to_csv(source, index=False)
    with pytest.raises(InvalidProblem, match=words):
        convert(source, tmp_path / "s.toml", stations=geojson(tmp_path), sigma="10 ns")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sigma": None}, r"the accuracy of the rows is unknown; state it with --sigma"),
        ({"stations": None}, "the station positions are unknown"),
        ({"columns": {"staton": "x"}}, "there is no role 'staton'; did you mean 'station'"),
        ({"columns": {"station": "statoin"}}, "no column 'statoin' for the station; did you mean 'station'"),
        ({"what": "arivals"}, "did you mean 'arrivals'"),
        ({"frame": "ecfe"}, "did you mean 'ecef'"),
        ({"unit": "nss"}, "did you mean 'ns'"),
        ({"sigma": "10 nss"}, "nss"),
        ({"out": "site.csv"}, r"must end in \.toml"),
        ({"out": "no/such/folder/site.toml"}, "the file cannot be written"),
    ],
)
def test_bad_options_are_sentences(options, words, tmp_path):
    given = {"stations": geojson(tmp_path), "sigma": "10 ns", "out": "site.toml"} | options
    out = tmp_path / given.pop("out")
    with pytest.raises(InvalidProblem, match=words):
        convert(arrivals(tmp_path), out, **given)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", r"sites\.geojson, line 1: this is not JSON"),
        ("[]", "no list of features"),
        ('{"features": []}', "no point among"),
        ('{"features": [{"geometry": {"type": "Point", "coordinates": [1, 2]}}]}', "feature 1: the point has no name"),
        (
            '{"features": [{"id": "A", "geometry": {"type": "Point", "coordinates": [1, 97]}}]}',
            r"feature 1: \[1, 97\] is not a point; write \[longitude, latitude, height\]",
        ),
    ],
)
def test_bad_geojson_names_the_feature(text, words, tmp_path):
    path = tmp_path / "sites.geojson"
    path.write_text(text)
    with pytest.raises(InvalidProblem, match=words):
        convert(path, tmp_path / "stations.csv")


def turned_back(place, seconds):
    """Return a place along the axes that the Earth had so many seconds ago."""
    angle = 7.2921151467e-5 * seconds
    x, y, z = place
    return np.array([x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle), z])


def pseudoranges(folder, unit="m"):
    receiver, clock = place(139.5, 35.3, 60.0), [3.2e5, -1.1e5]
    rng = np.random.default_rng(4)
    rows = []
    for k in range(2):
        for i, (azimuth, elevation) in enumerate(zip(rng.uniform(0, 6.28, 7), rng.uniform(0.3, 1.4, 7), strict=True)):
            e, n, u = ECEF.enu_axes(receiver)
            line = np.cos(elevation) * (np.sin(azimuth) * e + np.cos(azimuth) * n) + np.sin(elevation) * u
            satellite = turned_back(receiver + 2.3e7 * line, 2.3e7 / SPEED_OF_LIGHT)
            rows.append((100.0 + k, f"G{i:02d}", *satellite, 2.3e7 + clock[k]))
    table = pd.DataFrame(rows, columns=["t_gps_s", "sat", "sat_x_m", "sat_y_m", "sat_z_m", "pr_m"])
    path = folder / "gnss.csv"
    table.to_csv(path, index=False)
    return path, receiver


def test_pseudoranges_carry_their_satellites(tmp_path):
    source, receiver = pseudoranges(tmp_path)
    out = tmp_path / "gnss.toml"
    found = convert(source, out, sigma="2 m")
    assert (found.loaded.problem.epochs, found.loaded.problem.stations.count) == (2, 7)
    np.testing.assert_array_equal(found.loaded.times, [100.0, 101.0])
    fix = solve(by_epoch(found.loaded.problem))
    assert np.linalg.norm(fix.position - receiver, axis=-1).max() < 1e-2
    table = pd.read_csv(source)
    table.assign(sat_x_m=table["sat_x_m"] / 1e3, sat_y_m=table["sat_y_m"] / 1e3, sat_z_m=table["sat_z_m"] / 1e3).to_csv(
        source, index=False
    )
    with pytest.raises(InvalidProblem, match=r"row 1, column 'sat_x_m': the satellite is .* km from the centre"):
        convert(source, out, sigma="2 m")


def test_the_command_says_what_comes_next(tmp_path):
    source, sites, out = arrivals(tmp_path), geojson(tmp_path), tmp_path / "site.toml"
    arguments = ["convert", str(source), "--stations", str(sites), "--sigma", "10 ns", "--out", str(out)]
    told = RUN.invoke(app, arguments)
    assert told.exit_code == 0, told.output
    assert f"10 rows of 2 epochs at 5 stations. Next: optloc check {out}." in told.stdout
    found = json.loads(RUN.invoke(app, [*arguments, "--json", "--force"]).stdout)
    assert (found["rows"], found["epochs"], len(found["files"])) == (10, 2, 3)
    bad = RUN.invoke(app, [*arguments, "--column", "station", "--force"])
    assert (bad.exit_code, bad.stderr.count("\n")) == (2, 1)
    for verb in ("check", "fix"):
        assert RUN.invoke(app, [verb, str(out)]).exit_code == 0


@pytest.mark.data
def test_airliners_are_the_same_as_by_their_own_reader(data_dir, tmp_path):
    folder = data_dir / "locards_adsb"
    found = convert(
        folder / "measurements.csv",
        tmp_path / "adsb.toml",
        stations=folder / "stations.csv",
        sigma="30 m",
        columns={"message": "set+msg"},
    ).loaded
    own = datasets.load("adsb", folder=data_dir).problem
    assert found.problem.epochs == own.epochs == 763
    mine = found.problem.rows[0]
    theirs = own.rows[0]
    truth = pd.read_csv(folder / "truth.csv")
    labels = (truth["set"].astype(str) + "-" + truth["msg"].astype(str)).tolist()
    names = np.array(own.stations.names)
    place_of = {(labels[k], n): z for k, n, z in zip(theirs.epoch, names[theirs.a], theirs.z, strict=True)}
    here = np.array(found.problem.stations.names)
    off = [z - place_of[found.epochs[k], n] for k, n, z in zip(mine.epoch, here[mine.a], mine.z, strict=True)]
    assert np.abs(off).max() < 1e-3
