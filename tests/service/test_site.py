"""Sites: rows by name, rows that arrivals make, units of values, and files that no stream can have."""

import numpy as np
import pytest
from service.lines import SITE, C, site_in

from optloc import InvalidProblem
from optloc.service.site import FAST, SiteRow, UnknownName, read_site


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return site_in(tmp_path_factory.mktemp("site"), method=FAST)


def test_rows_are_found_by_kind_and_stations(site):
    assert site.find("tdoa", "C", "A") == 1
    assert site.name_of(1) == "tdoa C-A"
    assert site.find("tdoa", "C", "B") == SiteRow(0, -1, "tdoa", "C", "B")  # not listed, with the settings of its table
    with pytest.raises(UnknownName, match="a: there is no station 'G'"):
        site.find("tdoa", "G", "A")
    with pytest.raises(UnknownName, match="kind: the site has no rows of the kind 'toa'; did you mean 'tdoa'"):
        site.find("toa", "C", "")
    with pytest.raises(InvalidProblem, match="names station 'C' twice"):
        site.find("tdoa", "C", "C")


def test_arrivals_make_the_rows_of_the_stations_that_are_there(site):
    assert [row.name for row in site.between((0, 1, 3))] == ["tdoa B-A", "tdoa D-A"]
    # Without the reference of the file, all are compared with the first one.
    assert [row.name for row in site.between((1, 2, 4))] == ["tdoa C-B", "tdoa E-B"]
    assert site.between(()) == ()


def test_arrivals_and_values_become_metres(site):
    ready = site.ready((0, 1, 2), site.rows[3:])
    arrivals = np.array([[1e6, 0.0, 3e6]])  # picoseconds: B is a microsecond before A, C is two after it
    assert ready.si(arrivals, np.array([[10.0, 20.0]]))[0] == pytest.approx([-1e-6 * C, 2e-6 * C, 10.0, 20.0])
    assert site.ready((), ()) is None


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('{ a = "C" }', '{ a = "B" }', "tdoa B-A occurs twice"),
        ("[[measurements]]", '[target]\nmotion = "constant_velocity"\n\n[[measurements]]', "needs several epochs"),
    ],
)
def test_what_single_events_cannot_have_is_refused(tmp_path, old, new, said):
    path = tmp_path / "site.toml"
    path.write_text(SITE.replace("arrival_sigma", "sigma").replace(old, new))
    with pytest.raises(InvalidProblem, match=said):
        read_site(path)


def test_constraints_with_files_are_read_once_and_hold_for_each_event(tmp_path):
    (tmp_path / "road.csv").write_text("x,y\n0,1500\n1500,2500\n4000,2600\n")
    text = SITE + '[[constraints]]\nkind = "polyline"\nfile = "road.csv"\ntolerance = "5 m"\nname = "road"\n'
    site = site_in(tmp_path, text, FAST)
    (tmp_path / "road.csv").unlink()  # an event needs no file
    ready = site.ready((), site.rows[:4])
    paths = np.linalg.norm(site.position - [1400.0, 2600.0, 300.0], axis=1)
    fix = ready.fast(ready.si(np.zeros((1, 0)), (paths[1:5] - paths[0])[None]))
    assert [active.name for active in fix.active[0]] == ["road 1 upper"]
