"""Options on the wave and on the height in each command that takes them."""

import json
import math

import pytest
from progress import without_progress
from typer.testing import CliRunner

from optloc import load
from optloc.cli import app
from optloc.cli.wave import WAVE_OPTIONS, wave_options
from optloc.files.wave_speed import WaveOptions

ANCHORS = {"A": (0, 0, 4), "B": (20, 0, 4), "C": (20, 12, 4), "D": (0, 12, 4), "E": (10, 6, 5)}
SPEED = 343.21462268256795  # air of 20 degrees
FORMS = ["343.2146 m/s", "343+-5 m/s", "air:20C", "air:19.7C,50%", "profile.csv"]


def run(*words, text=None):
    """Return the result of a command."""
    return CliRunner().invoke(app, [str(word) for word in words], input=text)


def flight(name, i=0):
    """Return the time of flight from a cart at step `i` to an anchor, ms."""
    return 1e3 * math.dist((5.0 + 0.4 * i, 4.0 + 0.1 * i, 1.2), ANCHORS[name]) / SPEED


@pytest.fixture
def hall(tmp_path, monkeypatch):
    """Return a folder with anchors, arrivals of one pulse and of six, a site, and a profile of the speed."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.csv").write_text("name,x,y,z\n" + "".join(f"{k},{x},{y},{z}\n" for k, (x, y, z) in ANCHORS.items()))
    for name, count in (("one.csv", 1), ("six.csv", 6)):
        lines = [f"{i},{i},{k},{flight(k, i):.6f}\n" for i in range(count) for k in ANCHORS]
        (tmp_path / name).write_text("message,time_s,anchor,toa_ms\n" + "".join(lines))
    places = "".join(f'{{ name = "{k}", x = {x}, y = {y}, z = {z} }}, ' for k, (x, y, z) in ANCHORS.items())
    rows = "".join(f'{{ a = "{k}", z = {flight(k):.6f} }}, ' for k in ANCHORS)
    (tmp_path / "site.toml").write_text(
        f'format = 2\n[stations]\nrows = [{places}]\n[[measurements]]\nkind = "toa"\nunit = "ms"\n'
        f"sigma = 0.1\nrows = [{rows}]\n"
    )
    (tmp_path / "profile.csv").write_text(f"height_m,speed_m_s\n-10,{SPEED}\n10,{SPEED + 1e-3}\n")
    return tmp_path


TABLE = ("--stations", "a.csv", "--sigma", "0.1 ms")


@pytest.mark.parametrize("speed", FORMS)
def test_fix_takes_every_form(hall, speed):
    for words in (("one.csv", *TABLE), ("site.toml",)):
        allow = ("--allow", "unproven,curved,ambiguous")
        done = run("fix", *words, "--wave-speed", speed, "--height", "120 cm", "--json", *allow)
        assert done.exit_code == 0, done.output
        (fix,) = json.loads(done.stdout)["fixes"]
        assert (fix["x"], fix["y"], fix["z"]) == pytest.approx((5.0, 4.0, 1.2), abs=0.05)


def test_every_command_asks_for_a_missing_speed(hall):
    for words in (
        ("fix", "one.csv", *TABLE),
        ("fix", "site.toml"),
        ("check", "six.csv", *TABLE),
        ("track", "six.csv", *TABLE),
        ("convert", "six.csv", *TABLE, "--out", "out.toml"),
        ("live", "site.toml", "--check"),
    ):
        done = run(*words)
        assert done.exit_code == 2
        (sentence,) = without_progress(done.stderr)
        assert "--wave-speed air:20C" in sentence
        assert len(sentence) <= 200


def test_the_report_and_the_fix_name_the_speed(hall):
    done = run("fix", "one.csv", *TABLE, "--wave-speed", "air:20C", "--height", "1.2 m")
    assert done.output.count("343.215 m/s, dry air of 20 °C (ideal gas)") == 2
    done = run("check", "site.toml", "--wave-speed", "air:20C", "--no-solve")
    assert "343.215 m/s" in done.output


def test_check_track_and_convert_take_the_options(hall):
    assert run("check", "six.csv", *TABLE, "--wave-speed", "air:20C").exit_code == 0
    words = ("track", "six.csv", *TABLE, "--wave-speed", "air:20C", "--height", "1.2 m", "--json")
    done = run(*words)
    assert done.exit_code == 0, done.output
    last = json.loads(done.stdout)["scans"][-1]
    assert (last["x"], last["y"], last["z"]) == pytest.approx((7.0, 4.5, 1.2), abs=0.1)
    done = run("convert", "six.csv", *TABLE, "--wave-speed", "air:20C", "--height", "4 ft", "--out", "out.toml")
    assert done.exit_code == 0, done.output
    text = (hall / "out.toml").read_text()
    assert 'propagation_speed = "air:20C"' in text
    (band,) = load(hall / "out.toml").constraints
    assert (band.name, float(band.lower), float(band.upper)) == ("height", 1.2192, 1.2192)


def test_a_live_site_takes_the_options(hall):
    (hall / "events.ndjson").write_text(json.dumps({"event": "1", "z": [flight(k) for k in ANCHORS]}) + "\n")
    words = ("live", "site.toml", "--replay", "events.ndjson", "-q")
    done = run(*words, "--wave-speed", "air:20C", "--height", "1.2 m")
    assert done.exit_code == 0, done.output
    first = json.loads(done.stdout.splitlines()[0])
    assert first["position"] == pytest.approx([5.0, 4.0, 1.2], abs=1e-3)
    assert run(*words, "--wave-speed", "air:200C").exit_code == 2


def test_a_list_of_floors(hall):
    words = ("fix", "site.toml", "--wave-speed", "air:20C", "--json")
    (fix,) = json.loads(run(*words, "--height", "1.2 m, 470 cm, 8.2 m").stdout)["fixes"]
    assert (fix["status"], fix["z"]) == ("ok", pytest.approx(1.2))
    assert run(*words, "--height", "0 m, high").exit_code == 2


def test_floors_in_tracks_files_and_sites(hall):
    done = run("track", "six.csv", *TABLE, "--wave-speed", "air:20C", "--height", "1.2 m, 6 m", "--json")
    assert done.exit_code == 0, done.output
    last = json.loads(done.stdout)["scans"][-1]
    assert (last["x"], last["y"], last["z"]) == pytest.approx((7.0, 4.5, 1.2), abs=0.1)
    words = (*TABLE, "--wave-speed", "air:20C", "--height", "1.2 m, 6 m", "--out", "out.toml")
    assert run("convert", "six.csv", *words).exit_code == 0
    assert 'one_of = ["1.2 m", "6 m"]' in (hall / "out.toml").read_text()
    fixes = json.loads(run("fix", "out.toml", "--json").stdout)["fixes"]
    assert {(fix["status"], round(fix["z"], 6)) for fix in fixes} == {("ok", 1.2)}
    band = load(hall / "out.toml").constraints[0]
    assert (float(band.lower), float(band.upper)) == (1.2, 6.0)
    events = [{"event": str(i), "z": [flight(k) for k in ANCHORS]} for i in (1, 2)]
    (hall / "events.ndjson").write_text("".join(json.dumps(one) + "\n" for one in events))
    words = ("live", "site.toml", "--replay", "events.ndjson", "-q", "--wave-speed", "air:20C", "--height", "1.2 m, 6")
    done = run(*words)
    assert done.exit_code == 0, done.output
    records = [json.loads(line) for line in done.stdout.splitlines()]
    last = next(record for record in records if "position" in record)
    assert last["position"] == pytest.approx([5.0, 4.0, 1.2], abs=1e-3)
    rows = "".join(f'{{ a = "{k}", z = {math.dist((5.0, 4.0, 1.2), place)} }}, ' for k, place in ANCHORS.items())
    text = (hall / "site.toml").read_text().split("[[measurements]]")[0]
    (hall / "cart.toml").write_text(f'{text}[[measurements]]\nkind = "range"\nsigma = "5 cm"\nrows = [{rows}]\n')
    z = [math.dist((5.0, 4.0, 1.2), place) for place in ANCHORS.values()]
    (hall / "events.ndjson").write_text(json.dumps({"event": "1", "z": z, "time": 5.0}) + "\n")
    done = run("live", "cart.toml", "--replay", "events.ndjson", "-q", "--height", "1.2 m, 6 m", "--track")
    assert "a track needs one height" in done.stdout, done.stderr


@pytest.mark.parametrize(
    ("constraint", "told"),
    [
        ('one_of = ["0 m"]', "at least 2"),
        ('one_of = ["0 m", 0.0]', "two different heights"),
        ("one_of = [0.0, 3.0]\nexactly = 1.0", "a list of heights has no 'exactly'"),
        ('one_of = [0.0, 3.0]\n\n[[constraints]]\nkind = "height"\none_of = [0.0, 5.0]', "listed twice"),
        ('one_of = [0.0, 3.0]\n\n[[constraints]]\nkind = "height"\nmin = 4.0', "4"),
    ],
)
def test_wrong_lists_of_floors_are_one_sentence(hall, constraint, told):
    text = (hall / "site.toml").read_text() + f'\n[[constraints]]\nkind = "height"\n{constraint}\n'
    (hall / "wrong.toml").write_text(text)
    done = run("fix", "wrong.toml", "--wave-speed", "air:20C")
    assert done.exit_code == 2
    assert told in done.stderr


def test_wrong_options_are_one_sentence(hall):
    for words, told in (
        (("fix", "one.csv", *TABLE, "--wave-speed", "water:8C"), "salinity"),
        (("fix", "site.toml", "--wave-speed", "warm"), "no wave speed"),
        (("fix", "site.toml", "--wave-speed", "air:20C", "--wind", "west"), "is not a wind"),
        (("fix", "site.toml", "--two-way"), "has no ranges"),
        (("check", "one.csv", *TABLE, "--wave-speed", "air:20C", "--turn-around", "2 ms"), "--as range"),
        (("fix", "site.toml", "--wave-speed", "nowhere.csv"), "nowhere.csv"),
    ):
        done = run(*words)
        assert done.exit_code == 2
        (sentence,) = without_progress(done.stderr)
        assert told in sentence
        assert len(sentence) <= 200


def test_options_become_one_value():
    values = {"wave_speed": "air:20C", "wind": None, "two_way": False, "turn_around": "2 ms", "file": "a.csv"}
    assert set(WAVE_OPTIONS) <= set(values)
    assert wave_options(values) == WaveOptions("air:20C", None, True, "2 ms")
    assert values == {"file": "a.csv"}
    assert WaveOptions().stated == ""
    assert WaveOptions(wind="5,0").stated == "--wind"
