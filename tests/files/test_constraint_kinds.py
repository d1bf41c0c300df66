"""Each kind of constraint from a file, from the option and from Python: the same constraints and the same fix."""

import dataclasses
import json

import numpy as np
import pytest

from optloc import Frame, InvalidProblem, constraints, locate, solve
from optloc.files import load, read
from optloc.files.constraint_kinds import CONSTRAINT_KINDS, check_keys, kind_names, kind_of, moves
from optloc.files.constraint_table import constraint_of_text
from optloc.linear.constraints import violation
from optloc.models.surfaces import SURFACES, Surface

PLACES = {"A": (0.0, 0.0, 30.0), "B": (4000.0, 300.0, 0.0), "C": (200.0, 5000.0, 80.0), "D": (4100.0, 4700.0, 10.0)}
TRUTH = np.array([1500.0, 2200.0, 900.0])
FRAME = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0)


def text_of(rows):
    cells = (", ".join(f"{key} = {json.dumps(value)}" for key, value in row.items()) for row in rows)
    return "[" + ", ".join(f"{{ {each} }}" for each in cells) + "]"


def document(constraint="", more="", targets=(), epochs=1):
    """Return a problem file of ranges in an ENU frame, perhaps of a target that moves, or of two targets."""
    head = 'format = 2\n[frame]\nkind = "enu"\norigin = { lat_deg = 47.0, lon_deg = 8.0, height = 400.0 }\n'
    stations = [dict(zip(("name", *"xyz"), (name, *place), strict=True)) for name, place in PLACES.items()]
    rows = []
    for k in range(epochs):
        for number, target in enumerate(targets or [None]):
            place = TRUTH + np.array([40.0, -20.0, 5.0]) * (k + 30.0 * number)
            for name, error in zip(PLACES, (4.0, -3.0, 2.0, 1.0), strict=True):
                row = {"a": name, "z": float(np.linalg.norm(np.array(PLACES[name]) - place)) + error}
                rows.append(row | ({"target": target} if target else {}) | ({"time": 2.0 * k} if epochs > 1 else {}))
    text = f'{head}[stations]\nrows = {text_of(stations)}\n[[measurements]]\nkind = "range"\nsigma = 5.0\n'
    limits = f"[[constraints]]\n{constraint}\n" if constraint else ""
    return f"{text}rows = {text_of(rows)}\n{more}\n{limits}"


def written(folder, text):
    path = folder / "p.toml"
    path.write_text(text, encoding="utf-8")
    return path


def same(one, two):
    """Return whether two constraints have the same numbers, to the rounding of units."""
    assert type(one) is type(two)
    for field in dataclasses.fields(one):
        a, b = getattr(one, field.name), getattr(two, field.name)
        if field.name == "members":
            assert [len(member) for member in a] == [len(member) for member in b]
            for first, second in zip((x for m in a for x in m), (x for m in b for x in m), strict=True):
                same(first, second)
        elif isinstance(a, np.ndarray):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-6)
        else:
            assert a == b
    return True


GRID = np.linspace(0.0, 5000.0, 6)
LINES = GRID.tolist()
HEIGHTS = 300.0 + 0.02 * GRID[:, None] - 0.01 * GRID
MOVES = '[target]\nmotion = "constant_velocity"\n'
TURNS = '[target]\nmotion = "constant_acceleration"\n'
RUN = {"targets": ("u", "v"), "epochs": 3, "more": '[target]\nmotion = "constant_velocity"\n'}
CORNERS = [[0.0, 0.0], [4000.0, 0.0], [1400.0, 1400.0], [0.0, 4000.0]]
BLOCK = [[1000.0, 1900.0], [2000.0, 1900.0], [2000.0, 2600.0], [1000.0, 2600.0]]
ROAD = [[0.0, 900.0], [1000.0, 1500.0], [2500.0, 4000.0]]
# Each kind: its keys in a file, the same as text of the option, the constraints in Python, and settings of the file.
CASES = {
    "half-plane": (
        'normal = [3.0, 4.0]\noffset = "11 km"',
        "normal=3,4 offset=11 km",
        constraints.half_plane([3, 4, 0], 11e3),
        {},
    ),
    "fence": (
        'normal = [3.0, 4.0]\noffset = "11 km"\nsigma = 0.1\nunit = "km"',
        "normal=3,4 offset=11 km sigma=100 m",
        constraints.fence([3, 4, 0], 11e3, 100.0),
        {},
    ),
    "band": (
        'normal = [1.0, 1.0]\nmin = 3.0\nmax = "3500 m"\nunit = "km"',
        "normal=1,1 min=3 km max=3500 m",
        constraints.band([1, 1, 0], 3e3, 3500.0),
        {},
    ),
    "disc": (
        'x = "1 km"\ny = 2000\nradius = "500 m"',
        "x=1 km y=2000 radius=500 m",
        constraints.disc([1e3, 2e3], 500.0),
        {},
    ),
    "annulus": (
        'x = 1\ny = 2\ninner = 0.1\nouter = 0.4\nunit = "km"',
        "x=1 y=2 inner=100 m outer=400 m unit=km",
        constraints.annulus([1e3, 2e3], 100.0, 400.0),
        {},
    ),
    "keep-out-disc": (
        "x = 1400\ny = 2000\nradius = 700",
        "x=1400 y=2000 radius=700",
        constraints.keep_out_disc([1400, 2000], 700.0),
        {},
    ),
    "ball": (
        "x = 1000\ny = 2000\nz = 900\nradius = 300",
        "x=1000 y=2000 z=900 radius=300",
        constraints.ball([1e3, 2e3, 900.0], 300.0),
        {},
    ),
    "keep-out-ball": (
        "x = 1500\ny = 2100\nz = 900\nradius = 300",
        "x=1500 y=2100 z=900 radius=300",
        constraints.keep_out_ball([1500, 2100, 900.0], 300.0),
        {},
    ),
    "polygon": (f"corners = {CORNERS}", f"corners={CORNERS}", constraints.polygon(CORNERS), {}),
    "keep-out-polygon": (f"corners = {BLOCK}", f"corners={BLOCK}", constraints.keep_out_polygon(BLOCK), {}),
    "polyhedron": (
        "normals = [[1, 0, 0], [0, 1, 0], [0, 0, 2]]\noffsets = [1450, 9000, 1600]",
        "normals=[[1,0,0],[0,1,0],[0,0,2]] offsets=1450,9000,1600",
        constraints.polyhedron(np.diag([1, 1, 2]), [1450, 9000, 1600]),
        {},
    ),
    "polyline": (
        f'points = {ROAD}\ntolerance = "20 m"',
        f"points={ROAD} tolerance=20 m",
        constraints.polyline(ROAD, 20.0),
        {},
    ),
    "terrain": (
        f"x = {LINES}\ny = {LINES}\nheight = {HEIGHTS.tolist()}\nmin = 0\nmax = 500",
        f"x={LINES} y={LINES} height={HEIGHTS.tolist()} min=0 max=500",
        constraints.terrain(GRID, GRID, HEIGHTS, lower=0.0, upper=500.0),
        {},
    ),
    "height": ('exactly = "1200 m"', "exactly=1200 m", constraints.height(exactly=1200.0), {}),
    "above-ground": ("", "", constraints.height(0.0), {}),
    "box": (
        "max = [1450, inf, inf]",
        "max=1450,inf,inf",
        constraints.box([-np.inf] * 3, [1450.0, np.inf, np.inf])[:1],
        {},
    ),
    "visible": ('stations = ["B"]\nelevation = -30', 'stations=["B"] elevation=-30', None, {}),
    "speed": ('max = "60 km/h"', "max=60 km/h", constraints.speed("60 km/h"), {"epochs": 3, "more": MOVES}),
    "turn-rate": ('max = "3 deg/s"', "max=3 deg/s", constraints.turn_rate("3 deg/s"), {"epochs": 4, "more": TURNS}),
    "acceleration": (
        'max = 0.5\nunit = "m/s^2"',
        "max=0.5 m/s^2",
        constraints.acceleration(0.5),
        {"epochs": 4, "more": TURNS},
    ),
    "separation": (
        'between = ["u", "v"]\nmax = "1 km"',
        "between=u,v max=1 km",
        constraints.separation(0, 1, upper=1e3),
        RUN,
    ),
}


def test_every_kind_has_a_case():
    assert set(CASES) == set(CONSTRAINT_KINDS)


@pytest.mark.parametrize("kind", CASES)
def test_file_option_and_python_state_the_same(kind, tmp_path):
    keys, option, wanted, settings = CASES[kind]
    path = written(tmp_path, document(f'kind = "{kind}"\n{keys}', **settings))
    from_file = load(path)
    path.write_text(document(**settings), encoding="utf-8")
    table = constraint_of_text(f"{kind} {option}", "--constraint")
    from_option = read(path, more={"--constraint": table}).problem
    one, two = ((*each.constraints, *each.fences) for each in (from_file, from_option))
    assert len(one) == len(two) > 0
    assert all(same(a, b) for a, b in zip(one, two, strict=True))
    if wanted is not None:
        assert all(same(a, b) for a, b in zip(one, wanted, strict=True))


QUICK = ("disc", "keep-out-disc", "half-plane", "speed")


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[] if kind in QUICK else pytest.mark.slow) for kind in CASES]
)
def test_file_and_python_give_the_same_fix(kind, tmp_path):
    keys, _, wanted, settings = CASES[kind]
    from_file = load(written(tmp_path, document(f'kind = "{kind}"\n{keys}', **settings)))
    found = solve(from_file, "gtrs+lsr")
    assert np.isfinite(found.x).all()
    assert float(violation(from_file, found.x[None])[0]) < 1e-6
    if wanted is not None:
        other = solve(dataclasses.replace(from_file, constraints=tuple(wanted), fences=()), "gtrs+lsr")
        np.testing.assert_allclose(found.x, other.x, atol=1e-6)
        assert found.status == other.status


@pytest.mark.parametrize("kind", ["keep-out-disc", "box"])
def test_locate_takes_tables_and_constraints(kind):
    _, option, wanted, _ = CASES[kind]
    anchors = {name: place[:2] for name, place in PLACES.items()}
    ranges = {name: float(np.linalg.norm(np.array(place) - TRUTH[:2])) for name, place in anchors.items()}
    table = constraint_of_text(f"{kind} {option}".replace(",inf,inf", ",inf"), "x").model_dump(exclude_none=True)
    wanted = constraints.box([-np.inf] * 2, [1450.0, np.inf]) if kind == "box" else wanted
    one, two = (locate(anchors, ranges=ranges, sigma=5.0, constraints=each) for each in ([table], wanted))
    assert one.position.tolist() == two.position.tolist()
    assert one.active[()]


def test_coordinates_on_earth(tmp_path):
    lat, lon, height = FRAME.to_geodetic(np.array([[1000.0, 2000.0, 0.0]] * 2 + [[1000.0, 2000.0, 900.0]]))
    degrees = np.degrees([lat, lon]).T.tolist()
    disc = f'kind = "disc"\nlat_deg = {degrees[0][0]}\nlon = {degrees[0][1]}\nradius = 300'
    ball = f'kind = "ball"\nlat = {degrees[2][0]}\nlon = {degrees[2][1]}\nheight = {height[2]}\nradius = 300'
    for text, wanted in ((disc, [1e3, 2e3]), (ball, [1e3, 2e3, 900.0])):
        (found,) = load(written(tmp_path, document(text))).constraints
        np.testing.assert_allclose(found.coefficients, wanted, atol=0.5)
    road = FRAME.to_geodetic(np.c_[ROAD, np.zeros(3)])
    points = np.degrees(road[:2]).T.tolist()
    text = f'kind = "polyline"\npoints_deg = {points}\ntolerance = 20'
    (found,) = load(written(tmp_path, document(text))).constraints
    np.testing.assert_allclose(found.members[0][0].coefficients, np.ravel(ROAD[:2]), atol=0.5)


def test_names_of_constraints_and_targets(tmp_path):
    text = 'kind = "disc"\nname = "hall"\nx = 0\ny = 0\nradius = "9 km"'
    assert [c.name for c in load(written(tmp_path, document(text))).constraints] == ["hall"]
    (one, two) = load(written(tmp_path, document(text, **RUN))).constraints
    assert (one.name, one.target, two.name, two.target) == ("hall of u", 0, "hall of v", 1)
    road = f'kind = "polyline"\npoints = {ROAD}\ntolerance = 20\ntarget = "v"'
    (union,) = load(written(tmp_path, document(road, **RUN))).constraints
    assert {band.target for member in union.members for band in member} == {union.target} == {1}


@pytest.fixture
def registered(monkeypatch):
    """Register a quantity as an entry point does: the product of the first two coordinates."""
    surface = Surface(lambda t, c: c[0] * t.position[0] * t.position[1], "scaled product", "m", 1)
    monkeypatch.setitem(SURFACES._own, "product", surface)
    return surface


def test_a_registered_quantity_is_a_kind(registered, tmp_path):
    text = 'kind = "product"\ncoefficients = [1e-3]\nmax = "3.2 km"'
    (band,) = load(written(tmp_path, document(text))).constraints
    assert same(band, constraints.quantity("product", upper=3200.0, coefficients=[1e-3])[0])
    fix = solve(load(written(tmp_path, document(text))), "gtrs+lsr")
    assert fix.position[0] * fix.position[1] == pytest.approx(3.2e6, rel=1e-6)
    assert [active.name for active in fix.active[()]] == ["product upper"]
    assert "product" in kind_names()
    assert kind_of("product").summary == "scaled product"
    with pytest.raises(InvalidProblem, match="product has 0 coefficients, not 1"):
        load(written(tmp_path, document('kind = "product"\nmax = 3')))


def test_missing_and_unknown_keys():
    with pytest.raises(InvalidProblem, match="disc has no 'radius'; add the key 'radius'"):
        check_keys("disc", {"x", "y"}, "here")
    with pytest.raises(InvalidProblem, match="annulus has no key 'radius'"):
        check_keys("annulus", {"x", "y", "radius"}, "here")
    with pytest.raises(InvalidProblem, match="disc has no centre; give x, y or lat_deg, lon_deg"):
        check_keys("disc", {"radius"}, "here")
    with pytest.raises(InvalidProblem, match="terrain has no bound; give exactly or min or max"):
        check_keys("terrain", {"file"}, "here")
    with pytest.raises(InvalidProblem, match="polyline has no shape; give points or points_deg or file"):
        check_keys("polyline", {"tolerance"}, "here")
    check_keys("above-ground", set(), "here")


def test_only_courses_move(tmp_path):
    assert moves(load(written(tmp_path, document(epochs=3, more=MOVES))).motions[0])
    assert not moves(load(written(tmp_path, document())).motions[0])


@pytest.mark.parametrize(("key", "words"), [("z", "in the plane have no z"), ("height", "belongs to lat_deg")])
def test_a_ball_in_the_plane_does_not_ignore_its_height(key, words):
    anchors = {name: place[:2] for name, place in PLACES.items()}
    table = {"kind": "ball", "x": 0.0, "y": 0.0, key: 100.0, "radius": 50.0}
    with pytest.raises(InvalidProblem, match=words):
        locate(anchors, ranges=dict.fromkeys(anchors, 900.0), sigma=5.0, constraints=[table])
