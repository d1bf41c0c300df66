"""Constraints and known targets in problem files and on the command line: units, names, results, one sentence each."""

import json

import numpy as np
import pandas as pd
import pytest
from bad_input import HEAD, write
from progress import without_progress
from typer.testing import CliRunner

from optloc import Frame, InvalidProblem, solve
from optloc.base.types import Polygon
from optloc.cli import app
from optloc.files import from_table, load, read
from optloc.files.writer import write_measured
from optloc.show.pictures import plot_fixes
from optloc.show.pictures.scene import scene_of

RUN = CliRunner()
PLACES = {"A": (0, 0, 30), "B": (4000, 300, 0), "C": (200, 5000, 80), "D": (4100, 4700, 10)}
TRUTH = np.array([1500.0, 2200.0, 900.0])
ORIGIN = "origin = { lat_deg = 47.0, lon_deg = 8.0, height = 400.0 }"
ENU = HEAD.replace("[stations]", f'[frame]\nkind = "enu"\n{ORIGIN}\n[stations]')
PLANE = HEAD.replace(", z = 30.0", "").replace(", z = 0.0", "").replace(", z = 80.0", "").replace(", z = 10.0", "")


def rows(table):
    cells = ("{ " + ", ".join(f"{k} = {json.dumps(v)}" for k, v in row.items()) + " }" for row in table)
    return "rows = [" + ", ".join(cells) + "]\n"


def ranges(place, **more):
    d = len(place)
    return [{"a": a, "z": float(np.linalg.norm(np.array(p[:d]) - place)), **more} for a, p in PLACES.items()]


def ranging(table, head=ENU, sigma=5.0):
    return f'{head}[[measurements]]\nkind = "range"\nsigma = {sigma}\n{rows(table)}'


def demand(text, head=ENU):
    return ranging(ranges(TRUTH[: 2 if head == PLANE else 3]), head) + f"[[constraints]]\n{text}\n"


def run(*arguments, code=0):
    result = RUN.invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output + repr(result.exception)
    return result


FEET = 0.3048
BANDS = {
    'kind = "height"\nexactly = "500 m"': [("height", 500.0, 500.0)],
    'kind = "height"\nexactly = 500': [("height", 500.0, 500.0)],
    'kind = "height"\nexactly = "1640 ft"': [("height", 1640 * FEET, 1640 * FEET)],
    'kind = "height"\nmin = 1\nmax = "2 mi"\nunit = "km"': [("height", 1e3, 2 * 5280 * FEET)],
    'kind = "above-ground"': [("height", 0.0, np.inf)],
    'kind = "box"\nmin = [0.0, -inf, -inf]\nmax = [1.0, 2.0, inf]\nunit = "km"': [("x", 0.0, 1e3), ("y", -np.inf, 2e3)],
    'kind = "speed"\nmax = "36 km/h"\n[target]\nmotion = "constant_velocity"': [("speed", -np.inf, 10.0)],
    'kind = "visible"\nstations = ["B"]\nelevation = 30': [("sight of B", 0.5, np.inf)],
    'kind = "visible"': [(f"sight of {name}", 0.0, np.inf) for name in "ABCD"],
    'kind = "above-ground"\n[[constraints]]\nkind = "height"\nmax = 10': [("height", 0.0, 10.0)],
    'kind = "height"\nexactly = 5\n[[constraints]]\nkind = "height"\nexactly = "5 m"': [("height", 5.0, 5.0)],
}


@pytest.mark.parametrize("text", BANDS)
def test_bands_in_any_unit(text, tmp_path):
    problem = load(write(tmp_path, demand(text)))
    found = [(c.name, float(c.lower), float(c.upper)) for c in problem.constraints]
    assert [name for name, _, _ in found] == [name for name, _, _ in BANDS[text]]
    np.testing.assert_allclose([f[1:] for f in found], [b[1:] for b in BANDS[text]], rtol=1e-12)


def test_polygons_in_metres_and_degrees(tmp_path):
    metres = [[0.0, 0.0], [4000.0, 0.0], [4000.0, 4000.0], [0.0, 4000.0]]
    frame = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0)
    lat, lon, _ = frame.to_geodetic(np.c_[metres, np.zeros(4)])
    degrees = np.degrees([lat, lon]).T.tolist()
    one = load(
        write(tmp_path, demand(f'kind = "polygon"\ncorners = {[[x / 1e3, y / 1e3] for x, y in metres]}\nunit = "km"'))
    )
    two = load(write(tmp_path, demand(f'kind = "polygon"\ncorners_deg = {degrees}')))
    for problem in (one, two):
        (region,) = problem.constraints
        assert isinstance(region, Polygon)
        np.testing.assert_allclose(region.vertices, metres, atol=5e-3)


def test_a_file_is_written_again_with_its_constraints(tmp_path):
    text = (
        demand('kind = "box"\nmin = [0.0, -inf, 0.0]')
        + '[[constraints]]\nkind = "polygon"\ncorners = [[0, 0], [9, 0], [0, 9]]\n'
    )
    path = write(tmp_path, text)
    (tmp_path / "sub").mkdir()
    write_measured(path, tmp_path / "sub" / "again.toml", read(path).problem.z[None])
    one, two = load(path).constraints, load(tmp_path / "sub" / "again.toml").constraints
    assert [c.name for c in one] == [c.name for c in two]
    np.testing.assert_array_equal(one[-1].vertices, two[-1].vertices)


def test_a_data_frame_may_be_constrained():
    frame = {"kind": "enu", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "height": 400.0}}
    table = pd.DataFrame(ranges(TRUTH)[:3])
    height = {"kind": "height", "exactly": "1300.5 m"}
    problem = from_table(table, PLACES, kind="range", sigma=1.0, frame=frame, constraints=[height])
    assert solve(problem).geodetic[2] == pytest.approx(1300.5, abs=1e-6)


BAD = {
    "unknown kind": ('kind = "hight"', ["[[constraints]] 1", "'hight'", "did you mean 'height'"]),
    "unknown key": ('kind = "height"\nminimum = 3', ["'minimum'", "did you mean 'min'"]),
    "key of another kind": ('kind = "height"\nmin = 1\ncorners = [[0, 0]]', ["height has no key 'corners'"]),
    "key of none": ('kind = "above-ground"\nmin = 1', ["above-ground has no key 'min'"]),
    "nothing": ('kind = "height"', ["has no bound", "exactly or one_of or min or max"]),
    "exact and a band": ('kind = "height"\nexactly = 1\nmin = 0', ["exact or in a band"]),
    "unknown unit": ('kind = "height"\nmin = "3 mm/h"', ["[[constraints]] 1", "'mm/h'"]),
    "unit of another quantity": ('kind = "height"\nmin = "3 deg"', ["'deg'", "length"]),
    "nan": ('kind = "height"\nmin = nan', ["min is nan", "finite"]),
    "nan in a box": ('kind = "box"\nmin = [nan, 0.0, 0.0]', ["'x'", "lower bound is nan"]),
    "least above greatest": ('kind = "height"\nmin = 3\nmax = 1', ["'height'", "at least 3 m and at most 1 m"]),
    "two heights": (
        'kind = "height"\nexactly = 500\n[[constraints]]\nkind = "height"\nexactly = 600',
        ["'height'", "at least 600 m and at most 500 m"],
    ),
    "box of two": ('kind = "box"\nmin = [0, 0]', ["'min'", "2 coordinates, not 3"]),
    "box of a number": ('kind = "box"\nmin = 3', ["'min'", "one number, not 3"]),
    "height of a list": ('kind = "height"\nmin = [3.0]', ["'min'", "one bound"]),
    "two corners": ('kind = "polygon"\ncorners = [[0, 0], [1, 1]]', ["'corners'", "only 2 corners"]),
    "corner in space": ('kind = "polygon"\ncorners = [[0, 0], [1, 1], [1, 0, 0]]', ["corner 3 has 3"]),
    "bow tie": ('kind = "polygon"\ncorners = [[0, 0], [9, 10], [9, 0], [0, 8]]', ["not simple", "1-2 and 3-4"]),
    "repeated corner": ('kind = "polygon"\ncorners = [[0, 0], [9, 0], [9, 9], [0, 0]]', ["corner 4 repeats corner 1"]),
    "latitude": ('kind = "polygon"\ncorners_deg = [[97, 0], [9, 0], [9, 9]]', ["'corners_deg'", "latitude 97"]),
    "corners twice": ('kind = "polygon"\ncorners = [[0, 0]]\ncorners_deg = [[0, 0]]', ["twice"]),
    "unknown station": ('kind = "visible"\nstations = ["Q"]', ["'stations'", "no station 'Q'"]),
    "not a list": ('kind = "visible"\nstations = "A"', ["'A' is not a list"]),
    "beyond the zenith": ('kind = "visible"\nelevation = 95', ["outside -90 to 90"]),
    "unknown target": ('kind = "above-ground"\ntarget = "drone"', ["no row has the target 'drone'"]),
    "speed at rest": ('kind = "speed"\nmax = 3', ["'speed'", "moves"]),
    "known target": ('kind = "above-ground"\n[target]\nrows = [{ x = 0.0, y = 0.0, z = 0.0 }]', ["is known"]),
    "places of a free target": ('kind = "above-ground"\n[target]\nmotion = "free"\nrows = [{ x = 0 }]', ["are given"]),
    "known without places": ('kind = "above-ground"\n[target]\nmotion = "known"', ["[target]", "given once"]),
    "several positions": ('kind = "above-ground"\n[target]\nrows = [{ x = 0 }, { x = 1 }]', ["several positions"]),
}  # fmt: skip
IN_PLANE = {
    "height in a plane": ('kind = "height"\nmin = 1', ["stations in the plane have no height"]),
    "horizon without the Earth": ('kind = "visible"', ["geodetic frame"]),
    "degrees without the Earth": ('kind = "polygon"\ncorners_deg = [[0, 0], [9, 0], [9, 9]]', ["need an enu frame"]),
}
TABLE = {name: (demand(text), words) for name, (text, words) in BAD.items()}
TABLE |= {name: (demand(text, PLANE), words) for name, (text, words) in IN_PLANE.items()}


@pytest.mark.parametrize("name", TABLE)
def test_a_mistake_is_one_sentence_and_exit_code_2(name, tmp_path):
    text, words = TABLE[name]
    path = write(tmp_path, text)
    with pytest.raises(InvalidProblem):
        load(path)
    result = run("fix", path, code=2)
    assert result.stdout == ""
    assert len(without_progress(result.stderr)) == 1
    assert all(word in result.stderr for word in ["p.toml", *words]), result.stderr


def test_options_add_to_the_file(tmp_path):
    path = write(tmp_path, ranging(ranges(TRUTH)))
    out = tmp_path / "o.csv"
    found = json.loads(
        run("fix", path, "--height", "1200", "--box", "0,0,-inf:1000,3000,inf", "--out", out, "--json", code=1).stdout
    )
    assert found["fixes"][0]["status"] == "misfit"  # 500 m beside the ranges
    (fix,) = found["fixes"]
    assert (fix["height"], fix["x"]) == (pytest.approx(1200.0, abs=1e-6), pytest.approx(1000.0))
    assert [a["name"] for a in fix["active"]] == ["height equal", "x upper"]
    assert fix["active"][1]["multiplier"] > 0.0
    table = pd.read_csv(out)
    assert table["active"][0] == "height equal; x upper"
    assert float(table["multipliers"][0].split("; ")[1]) == pytest.approx(fix["active"][1]["multiplier"], rel=1e-5)
    text = run("fix", path, "--height", f"{(400.0 + TRUTH[2]) / FEET} ft").stdout
    assert "height held as given" in text
    assert "nan" not in text
    assert "to 1490 m, within the bounds" in run("fix", path, "--box", "0,0,0:1490,3000,inf").stdout


def test_what_lies_below_the_ground_is_no_alternative(tmp_path):
    path = write(tmp_path, ranging(ranges(TRUTH)))
    (fix,) = json.loads(run("fix", path, "--json", code=1).stdout)["fixes"]
    assert (fix["status"], len(fix["alternatives"]), fix["active"]) == ("ambiguous", 1, [])
    (fix,) = json.loads(run("fix", path, "--json", "--above-ground", "--allow", "unproven").stdout)["fixes"]
    assert (fix["alternatives"], fix["active"]) == ([], [])
    assert fix["status"] in ("ok", "unproven")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--height", "high"], "--height"),
        (["--height", "5 deg"], "'deg'"),
        (["--height", "-5", "--above-ground"], "at least 0 m and at most -5 m"),
        (["--box", "0,0"], "--box: '0,0' has one corner"),
        (["--box", "0,0:1,x"], "not a list"),
        (["--box", "0,0,nan:1,1,1"], "not a list"),
        (["--box", "0,0:1,1"], "2 coordinates, not 3"),
    ],
)
def test_bad_options(arguments, words, tmp_path):
    result = run("fix", write(tmp_path, ranging(ranges(TRUTH))), *arguments, code=2)
    assert words in result.stderr
    assert len(without_progress(result.stderr)) == 1


def test_an_infeasible_epoch_is_exit_code_1_and_leaves_the_others_alone(tmp_path):
    places = {0: TRUTH[:2], 1: TRUTH[:2] + 100.0}
    table = [row for k, place in places.items() for row in ranges(place, epoch=k)]
    apart = '[[constraints]]\nkind = "polygon"\ncorners = [[0, 0], [900, 0], [0, 900]]\n'
    apart += '[[constraints]]\nkind = "box"\nmin = [2000, 2000]\n'
    path, out = write(tmp_path, ranging(table, PLANE) + apart), tmp_path / "o.csv"
    run("fix", path, "--out", out, code=1)
    assert pd.read_csv(out)["status"].tolist() == ["infeasible"] * 2
    assert pd.read_csv(out)["x"].isna().all()
    for most, status, code in (
        (1595, "ok", 0),
        (1550, "contradictory", 1),
    ):  # 1 and 12 sigma before the second place
        inside = ranging(table, PLANE) + f'[[constraints]]\nkind = "box"\nmax = [{most}, 9000]\n'
        # an inequality that holds a fix is more than the proof covers
        run("fix", write(tmp_path, inside), "--allow", "unproven", "--out", out, "--force", code=code)
        found = pd.read_csv(out, keep_default_na=False)
        assert found["active"].tolist() == ["", "x upper"]
        assert found["status"].tolist() == ["ok", status]
        assert ("the constraint x upper disagree" in found["reason"][1]) == (code == 1)
        np.testing.assert_allclose(found["x"].astype(float), [1500.0, most], atol=1e-3)


def test_constraints_of_one_target_of_several(tmp_path):
    table = ranges(TRUTH, target="u") + ranges(TRUTH - 200.0, target="v")
    text = ranging(table) + '[[constraints]]\nkind = "height"\nexactly = 1000\ntarget = "v"\n'
    found = json.loads(run("fix", write(tmp_path, text), "--json", code=1).stdout)
    assert found["runs"][0]["findings"] == ["misfit", "unproven"]  # the height is hundreds of metres off
    assert [a["name"] for a in found["runs"][0]["active"]] == ["height of v equal"]
    assert {row["target"]: round(row["height"], 3) == 1000.0 for row in found["fixes"]} == {"u": False, "v": True}
    checked = json.loads(run("check", write(tmp_path, text), "--json").stdout)
    assert checked["constraints"] == ["height of v"]


@pytest.mark.parametrize("kind", ["cartesian", "geodetic"])
def test_a_known_target_calibrates(kind, tmp_path):
    """Ranges to a reference at known places give the bias of the receivers, here 25 m, at once or over a path."""
    path = np.stack([TRUTH, TRUTH + np.array([300.0, -100.0, 0.0])])
    table = [row for k, place in enumerate(path) for row in ranges(place, time=10.0 * k)]
    for row in table:
        row["z"] += 25.0
    if kind == "cartesian":
        where = [{"time": 10 * k, "x": p[0] / 1e3, "y": p[1] / 1e3, "z": p[2] / 1e3} for k, p in enumerate(path)]
    else:
        lat, lon, height = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0).to_geodetic(path)
        where = [
            {"time": 10 * k, "lat_deg": np.degrees(lat[k]), "lon_deg": np.degrees(lon[k]), "height": height[k] / 1e3}
            for k in range(2)
        ]
    text = (
        ranging(table, HEAD if kind == "cartesian" else ENU)
        + '[[biases]]\nname = "delay"\nper = "kind"\n[target]\nunit = "km"\n'
    )
    pd.DataFrame(where).to_csv(tmp_path / "path.csv", index=False)
    source = write(tmp_path, text + 'file = "path.csv"\n')
    problem = load(source)
    np.testing.assert_allclose(problem.motions[0].known[:, 0], path, atol=1e-5)
    assert problem.layout.find("delay")[0].unit == "m"
    (fix,) = json.loads(run("fix", source, "--json", "--allow", "unproven").stdout)["fixes"]
    assert fix["biases"][0]["value"] == pytest.approx(25.0, abs=1e-4)
    run("simulate", source, "--truth", "0,0,0", "--out", tmp_path / "s.toml", "-q")


def test_a_known_target_beside_an_unknown_one(tmp_path):
    table = [r | {"z": r["z"] + 25.0} for r in ranges(TRUTH, target="ref") + ranges(TRUTH - 300.0, target="u")]
    place = dict(zip("xyz", TRUTH.tolist(), strict=True))
    text = ranging(table, HEAD) + f'[[biases]]\nname = "delay"\nper = "kind"\n[targets.ref]\n{rows([place])}'
    (fix,) = json.loads(run("fix", write(tmp_path, text), "--json", "--allow", "ambiguous").stdout)["fixes"]
    # The stations are nearly in one plane, so the proof finds the mirror image of the target.
    assert (fix["target"], fix["status"], fix["certificate"]["proof"]) == ("u", "ambiguous", "global")
    np.testing.assert_allclose([fix["x"], fix["y"], fix["z"]], TRUTH - 300.0, atol=1e-2)
    assert (
        "nothing is unknown"
        in run("fix", write(tmp_path, ranging(ranges(TRUTH), HEAD) + f"[target]\n{rows([place])}"), code=2).stderr
    )


def test_units_of_biases(tmp_path):
    table = [r | {"time": float(k)} for k in range(4) for r in ranges(TRUTH)]
    drift = '[[biases]]\nname = "drift"\nform = "drift"\nper = "kind"\n[target]\nmotion = "static"\n'
    path = write(tmp_path, ranging(table, HEAD) + drift)
    assert load(path).layout.find("drift")[0].unit == "m/s"
    assert "m/s" in run("fix", path).stdout


def test_regions_are_drawn(tmp_path):
    text = ranging(ranges(TRUTH)) + '[[constraints]]\nkind = "box"\nmin = [0, 0, -inf]\nmax = [3000, 4000, inf]\n'
    problem = load(
        write(tmp_path, text + '[[constraints]]\nkind = "polygon"\ncorners = [[0, 0], [9000, 0], [0, 9000]]\n')
    )
    fix = solve(problem)
    scene = scene_of(problem, [fix])
    (box,), (polygon,) = (region.lines for region in scene.regions)
    assert (len(box), len(polygon)) == (5, 4)
    assert box[:, 0].tolist() == [0.0, 3000.0, 3000.0, 0.0, 0.0]
    assert np.isfinite(box).all()
    figure = plot_fixes(problem, fix)
    assert "region" in [text.get_text() for text in figure.legends[0].get_texts()]


# Files that constraints name.

SQUARE = [[1000.0, 1000.0], [2000.0, 1000.0], [2000.0, 3000.0], [1000.0, 3000.0]]
ROAD = [[0.0, 900.0], [1000.0, 1500.0], [2500.0, 4000.0]]
ASC = "ncols 4\nnrows 3\nxllcorner 0\nyllcorner 1000\ncellsize 1000\nNODATA_value -9999\n1 2 3 4\n5 6 7 8\n9 10 11 12\n"


def lonlat(points):
    frame = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0)
    lat, lon, _ = frame.to_geodetic(np.c_[points, np.zeros(len(points))])
    return np.degrees([lon, lat]).T.tolist()


def feature(kind, points):
    ring = [[*points, points[0]]] if kind == "Polygon" else points
    geometry = {"type": kind, "coordinates": ring}
    return json.dumps({"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": geometry}]})


def table(columns, points):
    return columns + "\n" + "".join(",".join(repr(float(value)) for value in point) + "\n" for point in points)


def test_lines_and_polygons_from_files(tmp_path):
    degrees, road = lonlat(SQUARE), lonlat(ROAD)
    contents = {
        "a.geojson": feature("Polygon", degrees),
        "a.csv": table("x_km,y_km", (np.array(SQUARE) / 1e3).tolist()),
        "b.csv": table("lat,lon", [point[::-1] for point in degrees]),
        "r.geojson": feature("LineString", road),
        "r.csv": table("x,y", ROAD),
        "s.csv": table("x,y", (np.array(ROAD) / 1e3).tolist()),
    }
    for name, text in contents.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    for name in ("a.geojson", "a.csv", "b.csv"):
        (found,) = load(write(tmp_path, demand(f'kind = "keep-out-polygon"\nfile = "{name}"'))).constraints
        assert found.outside
        np.testing.assert_allclose(found.vertices, SQUARE, atol=1e-3)
    for name, more in (("r.geojson", ""), ("r.csv", ""), ("s.csv", '\nunit = "km"')):
        text = demand(f'kind = "polyline"\nfile = "{name}"\ntolerance = "20 m"{more}')
        (found,) = load(write(tmp_path, text)).constraints
        np.testing.assert_allclose(found.members[1][0].coefficients, np.ravel(ROAD[1:]), atol=1e-3)
        assert float(found.members[0][0].upper) == 20.0


def test_grids_of_heights_from_files(tmp_path):
    x, y = np.arange(4.0) * 1e3 + 500.0, np.arange(3.0) * 1e3 + 1500.0
    heights = np.array([[9.0, 10, 11, 12], [5, 6, 7, 8], [1, 2, 3, 4]]).T
    points = [[a, b, heights[i, j]] for j, b in enumerate(y) for i, a in enumerate(x)]
    (tmp_path / "g.asc").write_text(ASC, encoding="utf-8")
    (tmp_path / "g.csv").write_text(table("x,y,height", points[::-1]), encoding="utf-8")
    for name in ("g.asc", "g.csv"):
        (found,) = load(write(tmp_path, demand(f'kind = "terrain"\nfile = "{name}"\nmin = "2 m"'))).constraints
        assert (found.table.x.tolist(), found.table.y.tolist()) == (x.tolist(), y.tolist())
        np.testing.assert_array_equal(found.table.height, heights)
        assert (float(found.lower), float(found.upper)) == (2.0, np.inf)


BAD_FILES = {
    "missing": ("no.csv", None, ["no.csv", "no such file"]),
    "another type": ("a.doc", "", ["'a.doc' has an unknown type", ".geojson"]),
    "outside": ("../a.csv", None, ["outside the folder"]),
    "no line": ("a.geojson", feature("Polygon", ROAD), ["a.geojson", "the file has no line"]),
    "two lines": (
        "a.geojson",
        json.dumps({"type": "GeometryCollection", "geometries": [{"type": "LineString", "coordinates": ROAD}] * 2}),
        ["the file has 2 lines"],
    ),
    "no points": ("a.geojson", '{"type": "LineString", "coordinates": [["a", 2], 3]}', ["not a list of points"]),
    "no json": ("a.geojson", "x", ["not JSON"]),
    "no columns": ("a.csv", "a,b\n1,2\n", ["a.csv", "no column 'x'"]),
    "no number": ("a.csv", "x,y\n1,b\n", ["row 1", "column 'y'"]),
    "one point": ("a.csv", "x,y\n1,2\n", ["the polyline has 1 points"]),
    "repeated point": ("a.csv", "x,y\n1,2\n1,2\n", ["point 2 repeats point 1"]),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_wrong_file_is_one_sentence(name, tmp_path):
    path, content, words = BAD_FILES[name]
    if content is not None:
        (tmp_path / path).write_text(content, encoding="utf-8")
    source = write(tmp_path, demand(f'kind = "polyline"\nfile = "{path}"\ntolerance = 20'))
    result = run("fix", source, code=2)
    assert len(without_progress(result.stderr)) == 1
    assert all(word in result.stderr for word in words), result.stderr


BAD_GRIDS = {
    "no header": ("g.asc", "1 2\n3 4\n", "the header has no ncols"),
    "short": ("g.asc", ASC.replace("9 10 11 12", "9 10"), "10 heights are not 4 columns by 3 rows"),
    "text": ("g.asc", ASC.replace("11", "wet"), "'wet' is not a height"),
    "word in the header": ("g.asc", ASC.replace("cellsize 1000", "cellsize wide"), "cellsize is 'wide'"),
    "gap": ("g.asc", ASC.replace("11", "-9999"), "1 cells have no height"),
    "no full grid": ("g.csv", "x,y,height\n0,0,1\n0,1,1\n1,0,1\n", "not a full grid of 2 by 2 points"),
    "repeated": ("g.csv", "x,y,height\n0,0,1\n0,0,1\n1,0,1\n1,1,2\n", "a grid point occurs twice"),
    "no heights": ("g.csv", "x,y\n0,0\n", "no column 'height'"),
}


@pytest.mark.parametrize("name", BAD_GRIDS)
def test_a_wrong_grid_is_one_sentence(name, tmp_path):
    path, content, words = BAD_GRIDS[name]
    (tmp_path / path).write_text(content, encoding="utf-8")
    with pytest.raises(InvalidProblem, match=words):
        load(write(tmp_path, demand(f'kind = "terrain"\nfile = "{path}"\nexactly = 0')))


def test_a_file_named_by_an_option_or_in_python_is_anywhere(tmp_path):
    (tmp_path / "roads").mkdir()
    (tmp_path / "roads" / "r.csv").write_text(table("x,y", ROAD), encoding="utf-8")
    line = tmp_path / "roads" / "r.csv"
    source = write(tmp_path / "roads" / "..", ranging(ranges(TRUTH[:2]), PLANE))
    text = run("fix", source, "--constraint", f"polyline file={line} tolerance=20 m", "--json", code=1).stdout
    assert json.loads(text)["fixes"][0]["active"][0]["name"].startswith("polyline")
    limits = [{"kind": "polyline", "file": str(line), "tolerance": 20.0}]
    places = {name: place[:2] for name, place in PLACES.items()}
    problem = from_table(pd.DataFrame(ranges(TRUTH[:2])), places, kind="range", sigma=5.0, constraints=limits)
    assert [c.name for c in problem.constraints] == ["polyline"]
    bad = run("fix", source, "--constraint", "disc x=0 y=0", "--constraint", "disc x=0 y=0 radius=0", code=2).stderr
    assert "--constraint 1: disc has no 'radius'" in bad


def test_copies_of_a_problem_file_keep_the_files_of_constraints(tmp_path):
    (tmp_path / "r.csv").write_text(table("x,y", ROAD), encoding="utf-8")
    source = write(tmp_path, demand('kind = "polyline"\nfile = "r.csv"\ntolerance = "20 m"\nname = "road"'))
    (tmp_path / "sub").mkdir()
    write_measured(source, tmp_path / "sub" / "again.toml", read(source).problem.z[None])
    (one,), (two,) = load(source).constraints, load(tmp_path / "sub" / "again.toml").constraints
    assert (one.name, str(one.members)) == (two.name, str(two.members))
    assert json.loads(run("check", source, "--json").stdout)["constraints"] == ["road"]


def test_the_option_is_listed_and_completed():
    listed = json.loads(run("list", "constraints", "--json").stdout)
    assert {"polyline", "terrain", "box"} <= {row["constraint"] for row in listed}
    assert "--constraint" in run("fix", "--help").stdout
