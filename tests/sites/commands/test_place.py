"""optloc place: files, tables, JSON, the chosen site's file, pictures, and broken input without a traceback."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import optloc
from optloc.cli import app
from optloc.files import read
from optloc.sites.placement.areas import convex_parts, inside, visible
from optloc.sites.placement.selection_file import read_selection
from optloc.sites.placement.sites import candidates_of

SITES = "\n".join(
    ["name,x,y,z,cost,group"]
    + [
        f"C{i},{x},{y},{i % 4},{i + 1},{'ab'[i % 2]}"
        for i, (x, y) in enumerate(
            [(-30, -30), (0, -28), (30, -25), (28, 0), (31, 29), (2, 30), (-29, 27), (-30, 1), (5, 4), (-9, 12)]
        )
    ]
)
PLACES = "name,x,y,z,weight\nhall,3,6,2,3\ngate,-36,-20,1,1\nroof,-10,15,9,1"
SELECTION = """format = 1
title = "Yard"
[choice]
choose = 5
[stations]
rows = [{ name = "Old", x = 12.0, y = -9.0, z = 7.0 }]
[candidates]
file = "sites.csv"
[targets]
file = "places.csv"
[[measurements]]
kind = "toa"
sigma = "30 cm"
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sites.csv").write_text(SITES)
    (tmp_path / "places.csv").write_text(PLACES)
    (tmp_path / "selection.toml").write_text(SELECTION)
    return tmp_path


def run(*words):
    return CliRunner().invoke(app, ["place", "selection.toml", "--draws", "0", *words])


def test_the_command_says_what_it_chose_and_how_good_that_is(folder):
    done = run("--out", "chosen.toml", "--plot", "map.png", "--fail-one")
    assert done.exit_code == 0, done.output
    assert "Yard: take C" in done.stdout
    assert "Bound after the loss of a station" in done.stdout
    assert (folder / "map.png").stat().st_size > 10_000


def test_the_written_file_has_the_bound_that_was_told(folder):
    told = json.loads(run("--json", "--out", "chosen.toml").stdout)
    loaded, candidates = (
        read("chosen.toml", values=False).problem,
        candidates_of(read_selection(folder / "selection.toml").selection),
    )
    assert {*loaded.stations.names} == {*told["chosen"], "Old"}
    priors = tuple(replace(prior, mean=prior.mean[..., : len(prior.mean)]) for prior in candidates.problem.priors)
    for place, vector, record in zip(candidates.names, candidates.vectors, told["places"], strict=False):
        bound = optloc.crlb(replace(loaded, priors=priors), vector)[:3, :3]
        assert np.sqrt(np.trace(bound)) == pytest.approx(record["sigma"], rel=1e-9), place
    assert told["value"] == pytest.approx(np.average([p["sigma"] ** 2 for p in told["places"]], weights=[3, 1, 1]))
    assert told["closed"]


def test_budgets_groups_ranges_and_sight_are_read(folder):
    sight = "candidate,place,sight\nC0,hall,0\nC1,gate,2\n"
    (folder / "sight.csv").write_text(sight)
    text = SELECTION.replace("choose = 5", "budget = 24.0") + 'range_max = "60 m"\n[sight]\nfile = "sight.csv"\n'
    (folder / "selection.toml").write_text(text + '[[groups]]\ngroup = "a"\nmost = 3\n')
    told = json.loads(run("--json").stdout)
    numbers = [int(name[1:]) for name in told["chosen"]]
    assert sum(number + 1 for number in numbers) <= 24
    assert sum(number % 2 == 0 for number in numbers) <= 3
    selection = read_selection(folder / "selection.toml").selection
    assert selection.sight[0, 0] == 0.0
    assert selection.sight[1, 1] == 2.0
    candidates = candidates_of(selection)
    far = np.linalg.norm(candidates.vectors[:, None, :3] - candidates.problem.stations.position[0], axis=-1) > 60.0
    assert (candidates.problem.weight[far] == 0.0).all()


def test_an_area_and_a_refinement(folder):
    ring = [[-40, -40], [40, -40], [40, 40], [0, 40], [0, 0], [-40, 0], [-40, -40]]
    (folder / "area.json").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    area = '[targets]\npolygon = "area.json"\nspacing = "20 m"\nheight = "1 m"'
    text = SELECTION.replace('[targets]\nfile = "places.csv"', area)
    (folder / "selection.toml").write_text(text)
    selection = read_selection(folder / "selection.toml").selection
    assert len(selection.places) == 12
    assert (selection.places[:, 2] == 1.0).all()
    parts = convex_parts(np.array(ring[:-1], float))
    points = np.random.default_rng(0).uniform(-45, 45, (500, 2))
    held = sum(inside(points, part).astype(int) for part in parts)
    assert (held == inside(points, np.array(ring[:-1], float))).all()


def test_ground_hides_what_is_behind_it(folder):
    x = np.linspace(-40, 40, 9)
    rows = [f"{a},{b},{20.0 if abs(a) < 5 else 0.0}" for a in x for b in x]
    (folder / "ground.csv").write_text("x,y,z\n" + "\n".join(rows))
    (folder / "selection.toml").write_text(SELECTION + '[sight]\nterrain = "ground.csv"\n')
    selection = read_selection(folder / "selection.toml").selection
    assert selection.sight is not None
    names = selection.problem.stations.names
    assert selection.sight[1, names.index("C2")] == 0.0  # the gate is west of the ridge, C2 east of it
    assert visible is not None


def test_an_ordinary_problem_file_serves_too(folder):
    done = CliRunner().invoke(app, ["new", "toa", "--out", "site.toml"])
    assert done.exit_code == 0
    done = CliRunner().invoke(app, ["place", "site.toml", "-k", "4", "--at", "1500,900,400", "--draws", "0", "--json"])
    assert len(json.loads(done.stdout)["chosen"]) == 4
    done = CliRunner().invoke(app, ["place", "site.toml", "-k", "5", "--at", "1500,900,400", "--draws", "0", "--rows"])
    assert done.exit_code == 0
    assert "toa " in done.stdout


BROKEN = {
    "no such criterion": (("choose = 5", 'choose = 5\ncriterion = "trace"'), "'trace' is unknown"),
    "a misspelt key": (("choose = 5", "chose = 5"), "did you mean"),
    "too many": (("choose = 5", "choose = 11"), "11 sites are wanted, but there are 10"),
    "no file": (('"sites.csv"', '"nowhere.csv"'), "nowhere.csv"),
    "no noise": (('sigma = "30 cm"', ""), "no noise"),
    "pairs": (('kind = "toa"', 'kind = "tdoa"\nb = "Old"'), "arrival_sigma"),
    "twice": (('name = "Old"', 'name = "C1"'), "used twice"),
    "no kind": (('kind = "toa"', ""), "kind"),
    "nothing to choose": (("choose = 5", ""), "number of sites to take is missing"),
    "a number in words": (("choose = 5", 'choose = "five"'), "choose"),
    "format": (("format = 1", "format = 7"), "format"),
    "group": (("[candidates]", '[[groups]]\ngroup = "zz"\nmost = 1\n[candidates]'), "zz"),
    "weights": ("hall,3,6,2,0", "is not positive"),
    "place": ("hall,-30,-30,0,3", "at the position of station"),
    "cell": ("hall,x,6,2,3", "row 1"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_selections_are_one_sentence(folder, name):
    change, said = BROKEN[name]
    if isinstance(change, tuple):
        (folder / "selection.toml").write_text(SELECTION.replace(*change))
    else:
        (folder / "places.csv").write_text(PLACES.replace("hall,3,6,2,3", change))
    done = run()
    assert done.exit_code == 2, done.output
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.count("\n") <= 1


def test_groups_that_allow_fewer_sites_are_one_sentence(folder):
    (folder / "selection.toml").write_text(
        SELECTION + '[[groups]]\ngroup = "a"\nmost = 1\n[[groups]]\ngroup = "b"\nmost = 2\n'
    )
    done = run()
    assert done.exit_code == 2
    assert "5 sites are wanted, but the groups allow at most 3" in " ".join(done.output.split())
    assert "Traceback" not in done.output
