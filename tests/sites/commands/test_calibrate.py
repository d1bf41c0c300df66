"""optloc calibrate: files, table, JSON, the site's file, pictures, and broken input without a traceback."""

import json

import numpy as np
import pytest
from sites.calibration.scenes import hall
from typer.testing import CliRunner

from optloc.cli import app
from optloc.files import read
from optloc.sites.calibration.network_file import read_network

FILE = """format = 1
[stations]
rows = [{ name = "A1" }, { name = "A2" }, { name = "A3" }, { name = "A4" }, { name = "A5" }, { name = "A6" },
  { name = "A7" }, { name = "A8" }]
[[measurements]]
kind = "toa"
sigma = "3 cm"
file = "pulses.csv"
"""


@pytest.fixture
def folder(tmp_path):
    _, z = hall(2, 8, 30, 0.03)
    rows = [f"p{j},A{i + 1},{float(z[j, i])!r}" for j in range(30) for i in range(8)]
    (tmp_path / "pulses.csv").write_text("\n".join(["epoch,a,z", *rows]))
    (tmp_path / "hall.toml").write_text(FILE)
    return tmp_path


def run(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


def test_a_file_becomes_stations_a_picture_and_a_problem_file(folder):
    out, picture = folder / "surveyed.toml", folder / "network.svg"
    done = run("calibrate", folder / "hall.toml", "--gauge", "A1,A2,A3", "--out", out, "--plot", picture)
    assert done.exit_code == 0, done.output
    assert "status ok" in done.output
    assert picture.read_text().startswith("<?xml")
    stations = read(out).problem.stations
    assert stations.names == tuple(f"A{i + 1}" for i in range(8))
    told = json.loads(run("calibrate", folder / "hall.toml", "--gauge", "A1,A2,A3", "--json").stdout)
    assert stations.position.reshape(8, 3) == pytest.approx(np.array([s["position"] for s in told["stations"]]))
    fixed = json.loads(run("fix", out, "--json").stdout)
    statuses = [fix["status"] for fix in fixed["fixes"]]
    assert statuses.count("ok") > 20


def test_what_is_known_clocks_and_distances_are_read(folder):
    text = FILE.replace('{ name = "A1" }', '{ name = "A1", x = 100, z = 250, sigma = 5 }').replace(
        "[stations]", '[stations]\nunit = "cm"\nsynchronised = false'
    )
    text = text.replace('propagation_speed = "343 m/s"', "")
    text += '[[measurements]]\nkind = "station_range"\nsigma = "2 cm"\nrows = [{ a = "A1", b = "A2", z = 7.5 }]\n'
    (folder / "hall.toml").write_text(text)
    net = read_network(folder / "hall.toml")
    assert net.place[0] == pytest.approx([1.0, 0.0, 2.5])
    assert net.place_sigma[0].tolist() == [0.05, np.inf, 0.05]
    assert not net.synchronised
    assert (net.between.tolist(), net.distance.tolist()) == ([[0, 1]], [7.5])


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('kind = "toa"', 'kind = "azimuth"', "azimuth"),
        ('sigma = "3 cm"', "", "standard deviation"),
        ('sigma = "3 cm"', 'sigma = "3 kg"', "kg"),
        ('sigma = "3 cm"', "sigma = 0", "hall.toml, [[measurements]] 1"),
        ('sigma = "3 cm"', 'sigma = "estimate"', "is no amount"),
        ("format = 1", "format = 1\npropagation_speed = -343", "the speed -343"),
        ('kind = "toa"', 'kind = "toa"\ncolumns = { a = "epoch" }', "p0"),
        ('kind = "toa"', 'kind = "tdoa"\ncolumns = { b = "a" }', "names station 'A1' twice"),
        ('{ name = "A8" }', '{ name = "A7" }', "A7"),
        ('{ name = "A8" }', '{ name = "B8" }', "A8"),
        ("format = 1", "format = 1\nspeed = 3", "speed"),
        ("format = 1", 'format = 2\nframe = { kind = "ecef" }', "optloc fix"),
        ("format = 1", "format = 3", "format = 2"),
        ('{ name = "A8" }', '{ name = "A8", x = "far" }', "far"),
    ],
)
def test_broken_files_are_refused_in_a_sentence(folder, old, new, told):
    (folder / "hall.toml").write_text(FILE.replace(old, new))
    done = run("calibrate", folder / "hall.toml")
    assert done.exit_code == 2, done.output
    assert told in done.output
    assert "Traceback" not in done.output


def test_problems_and_networks_are_told_apart(folder):
    (folder / "known.toml").write_text(
        'format = 2\nstations.rows = [{ name = "A", x = 0.0, y = 0.0 }, { name = "B", x = 9.0, y = 0.0 }]\n'
        '[[measurements]]\nkind = "range"\nsigma = 1.0\nrows = [{ a = "A", z = 5.0 }, { a = "B", z = 6.0 }]\n'
    )
    for command, name, told in (("calibrate", "known.toml", "optloc fix"), ("fix", "hall.toml", "optloc calibrate")):
        done = run(command, folder / name)
        assert done.exit_code == 2
        assert told in " ".join(done.output.split())


def test_coordinates_of_a_network_may_name_their_unit(folder):
    text = FILE.replace('{ name = "A1" }', '{ name = "A1", "X [cm]" = 100.0, y_m = 2.5 }')
    (folder / "hall.toml").write_text(text)
    net = read_network(folder / "hall.toml")
    assert net.place[0] == pytest.approx([1.0, 2.5, 0.0])
    assert net.place_sigma[0].tolist() == [0.0, 0.0, np.inf]


def test_names_of_outputs_are_asked_for_before_the_search(folder, monkeypatch):
    def never(*_, **__):
        raise AssertionError("it searched")

    monkeypatch.setattr("optloc.sites.calibration.calibrate", never)
    done = run("calibrate", folder / "hall.toml", "--out", folder / "surveyed.csv")
    assert done.exit_code == 2
    assert ".toml" in done.output
    assert run("calibrate", folder / "hall.toml", "--plot", folder / "net.xyz").exit_code == 2


def test_residuals_are_drawn_beside_the_law_that_is_left_of_the_noise():
    from optloc.sites.calibration.network_map import plot_network

    rng = np.random.default_rng(0)
    stations, pulses = rng.standard_normal((4, 2)), rng.standard_normal((9, 2))
    residuals = np.append(0.5 * rng.standard_normal(399), 40.0)
    figure = plot_network("ABCD", stations, 0.01 * np.eye(8), pulses, np.full((4, 2), np.nan), [], residuals, 100, "t")
    axes = figure.axes[-1]
    (law,) = axes.lines
    x, density = law.get_data()
    assert np.trapezoid(density, x) == pytest.approx(1.0, abs=1e-3)
    assert np.sqrt(np.trapezoid(x**2 * density, x)) == pytest.approx(0.5, abs=1e-3)  # sqrt(100 / 400)
    assert sum(bar.get_height() * bar.get_width() for bar in axes.patches) == pytest.approx(1.0)
    assert "1 beyond 5" in axes.get_title()


def test_a_network_that_is_open_is_no_site(folder):
    few = (folder / "pulses.csv").read_text().splitlines()[:17]
    (folder / "pulses.csv").write_text("\n".join(few))
    done = run("calibrate", folder / "hall.toml")
    assert done.exit_code == 1
    assert "too few rows" in done.output
    assert run("calibrate", folder / "hall.toml", "--out", folder / "site.toml").exit_code == 2


def test_the_wave_speed_of_a_network_is_an_option(folder):
    lines = (folder / "pulses.csv").read_text().splitlines()
    (folder / "pulses.csv").write_text("\n".join(lines[: 1 + 12 * 8]))  # twelve pulses at eight stations are enough
    text = (folder / "hall.toml").read_text().replace('sigma = "3 cm"', 'unit = "s"\nsigma = "0.1 ms"')
    (folder / "hall.toml").write_text(text)
    by_option = read_network(folder / "hall.toml", "air:20C")
    (folder / "hall.toml").write_text(text.replace("format = 1", 'format = 1\npropagation_speed = "air:20C"'))
    by_key = read_network(folder / "hall.toml")
    assert by_option.z == pytest.approx(by_key.z)
    assert by_option.sigma.min() == pytest.approx(0.0343215, rel=1e-4)
    done = run("calibrate", folder / "hall.toml")
    assert "Wave speed: 343.2" in done.output
    assert json.loads(run("calibrate", folder / "hall.toml", "--json").stdout)["wave_speed"].startswith("343.2")
    for speed, words in (("343+-5 m/s", "the speed of a network is exact"), ("warm", "no wave speed")):
        done = run("calibrate", folder / "hall.toml", "--wave-speed", speed)
        assert done.exit_code == 2
        assert words in done.stderr
