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
