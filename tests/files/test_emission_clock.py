"""The clock of emission times: tables with dates and numbers, S waves alone, and files without a clock."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.cli.file_fixes import fix_file
from optloc.files.convert import interpret_table
from optloc.files.reader import read
from optloc.files.table_import import ColumnHints

STATIONS = {"A": (0.0, 0.0), "B": (9.0, 1.0), "C": (1.0, 9.0), "D": (9.0, 8.0), "E": (4.0, -6.0)}
QUAKE, ORIGIN = np.array([4.0, 3.0]), np.datetime64("2024-05-01T10:00:11.250", "us")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with a table of stations, km."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "st.csv").write_text("name,x_km,y_km\n" + "".join(f"{k},{x},{y}\n" for k, (x, y) in STATIONS.items()))
    return tmp_path


def delay(name, speed):
    """Return the travel time to a station, seconds, for a speed in km/s."""
    return float(np.linalg.norm(QUAKE - STATIONS[name])) / speed


def row_of(folder, text, **hints):
    """Return the row of the fix of a table as a dictionary of columns."""
    (folder / "t.csv").write_text(text)
    hints = ColumnHints(stations=folder / "st.csv", **({"sigma": "10 ms"} | hints))
    found = fix_file(interpret_table(folder / "t.csv", hints).read({}), "auto", True)
    return {name: column[0] for name, column in found.columns.items()}


@pytest.mark.parametrize("waves", ["P", "PS", "S"])
def test_dates_give_the_date_of_the_origin(folder, waves):
    speeds = {"P": 6.0, "S": 3.5}
    lines = [
        f"{name},{wave},{ORIGIN + np.timedelta64(round(delay(name, speeds[wave]) * 1e6), 'us')}Z\n"
        for wave in waves
        for name in STATIONS
    ]
    row = row_of(folder, "station,phase,time\n" + "".join(lines), vp="6 km/s", vs="3.5 km/s")
    expected = (ORIGIN - np.datetime64(0, "us")).astype(float) / 1e6
    assert row["emission_s"] == pytest.approx(expected, abs=1e-4)
    assert row["emission_time"].startswith("2024-05-01T10:00:11.2")
    assert row["emission_time"].endswith("Z")
    # the errors of arrivals are 10 ms
    assert 0.003 < row["sigma_emission_s"] < 0.1


def test_numbers_give_seconds_on_their_clock(folder):
    lines = "".join(f"1,{name},{13.5 + delay(name, 0.34):.6f}\n" for name in STATIONS)
    row = row_of(folder, "message,station,toa_s\n" + lines, wave=waves_of("340 m/s"))
    assert row["emission_s"] == pytest.approx(13.5, abs=1e-3)
    assert "emission_time" not in row


def waves_of(speed):
    """Return the options on the wave."""
    from optloc.files.wave_speed import WaveOptions

    return WaveOptions(speed)


def test_several_messages_have_separate_origins(folder):
    lines = [f"{i},{name},{20 * i + delay(name, 0.34):.6f}\n" for i in (1, 2, 3) for name in STATIONS]
    (folder / "t.csv").write_text("message,station,toa_s\n" + "".join(lines))
    hints = ColumnHints(stations=folder / "st.csv", sigma="10 ms", wave=waves_of("340 m/s"))
    found = fix_file(interpret_table(folder / "t.csv", hints).read({}), "auto", True)
    assert found.columns["emission_s"] == pytest.approx([20.0, 40.0, 60.0], abs=1e-3)


def test_lengths_and_differences_have_no_origin(folder):
    lines = "".join(f"1,{name},{1000.0 * np.linalg.norm(QUAKE - at):.3f}\n" for name, at in STATIONS.items())
    row = row_of(folder, "message,station,pseudorange_m\n" + lines, sigma="5 m")
    assert "emission_s" not in row


def test_the_key_needs_arrivals_with_a_time(folder):
    places = "".join(f'{{ name = "{k}", x = {x}, y = {y} }}, ' for k, (x, y) in STATIONS.items())
    rows = "".join(f'{{ a = "{k}", z = 1.0 }}, ' for k in STATIONS)
    (folder / "p.toml").write_text(
        f'format = 2\n[stations]\nrows = [{places}]\n[[measurements]]\nkind = "toa"\nunit = "ns"\nsigma = 1.0\n'
        f'after = "date"\nrows = [{rows}]\n'
    )
    with pytest.raises(InvalidProblem, match="after is for arrivals with a time"):
        read(folder / "p.toml")
