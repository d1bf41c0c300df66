"""Readers of real data sets: a clear sentence where the data are missing or others, and what a loaded set holds."""

import hashlib
import re
from inspect import signature
from pathlib import Path

import numpy as np
import pytest

import optloc
from optloc import InvalidProblem
from optloc.lab import datasets
from optloc.lab.datasets.catalogue import ENTRIES
from optloc.lab.datasets.reading import VARIABLE
from optloc.problem.noise import variances


def test_without_a_folder_there_is_nothing_and_a_sentence(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    assert datasets.available() == ()
    with pytest.raises(InvalidProblem, match=r"OPTLOC_DATA: no folder .* set the variable OPTLOC_DATA"):
        datasets.load("uwb")
    monkeypatch.setenv(VARIABLE, "/no/such/folder")
    assert datasets.available() == ()
    with pytest.raises(InvalidProblem, match=r"/no/such/folder: there is no such folder"):
        datasets.load("uwb")


def test_names_and_options_are_checked(tmp_path):
    with pytest.raises(InvalidProblem, match="did you mean 'plaza'"):
        datasets.load("plazza", folder=tmp_path)
    with pytest.raises(InvalidProblem, match="no option 'fligth'; did you mean 'flight'"):
        datasets.load("uwb", folder=tmp_path, fligth="F01")


def test_the_page_names_every_set_with_its_options_licence_and_source():
    text = (Path(__file__).parents[3] / "docs" / "datasets.md").read_text(encoding="utf-8")
    lines = {
        name: next(line for line in text.splitlines() if line.startswith(f"| `{name}`")) for name in datasets.NAMES
    }
    for name, entry in ENTRIES.items():
        assert f"`{entry.folder}`" in lines[name]
        assert entry.licence.partition(" (")[0] in lines[name]
        for option in list(signature(entry.reader(name)).parameters)[1:]:
            assert f"`{option}`" in lines[name], (name, option)
        for file in entry.sha256:
            assert file.removesuffix(".csv") in lines[name]
        assert all(place in text for place in re.findall(r"github\.com/[\w/-]+", entry.source))


def plaza(folder, ranges="t_s,beacon,range_m\n0.0,5,1.0\n"):
    place = folder / "plaza_range"
    place.mkdir()
    (place / "ranges.csv").write_text(ranges)
    return place


def test_missing_and_changed_files_are_named(tmp_path):
    place = plaza(tmp_path)
    found = hashlib.sha256((place / "ranges.csv").read_bytes()).hexdigest()[:12]
    with pytest.raises(InvalidProblem, match=rf"ranges\.csv: this is a different file: .* {found}"):
        datasets.load("plaza", folder=tmp_path)
    with pytest.raises(InvalidProblem, match=r"stations\.csv: there is no such file"):
        datasets.load("plaza", folder=tmp_path, verify=False)
    assert datasets.available(tmp_path) == ()


def test_files_that_were_changed_are_read_when_that_is_wanted(tmp_path):
    times = np.arange(0.0, 20.0, 0.2)
    rows = "".join(f"{t:.1f},{b},10.0\n" for t in times for b in (1, 2, 3))
    place = plaza(tmp_path, f"t_s,beacon,range_m\n{rows}")
    (place / "stations.csv").write_text("beacon,x_m,y_m\n1,0,0\n2,10,0\n3,0,10\n")
    (place / "truth.csv").write_text("t_s,x_m,y_m,heading_rad\n" + "".join(f"{t:.1f},5,5,0\n" for t in times))
    assert datasets.available(tmp_path) == ("plaza",)
    data = datasets.load("plaza", folder=tmp_path, verify=False)
    assert data.problem.epochs == len(data.truth) == 6
    with pytest.raises(InvalidProblem, match="form: 'afine' is unknown; did you mean 'affine'"):
        datasets.load("plaza", folder=tmp_path, verify=False, form="afine")


# Name, options: batch shape, epochs, shape of the truth.
WHOLE = [
    ("uwb", {}, (), 84, (84, 3)),
    ("uwb", {"flight": "F03", "shared": False}, (), 104, (104, 3)),
    ("adsb", {"refraction": True}, (), 763, (763, 3)),
    ("gnss", {"every": 6}, (30,), 1, (3,)),
    ("gnss", {"session": "N176", "form": "run"}, (), 151, (3,)),
    ("mrclam", {"kinds": ("azimuth",), "every": 10}, (), 69, (69, 2)),
    ("plaza", {"form": "affine"}, (), 155, (155, 2)),
    ("starloc", {"count": 20}, (20,), 1, (20, 3)),
]


@pytest.mark.data
@pytest.mark.parametrize(("name", "options", "batch", "epochs", "truth"), WHOLE, ids=str)
def test_sets_are_read_whole(data_dir, name, options, batch, epochs, truth):
    data = datasets.load(name, folder=data_dir, **options)
    assert (data.problem.batch_shape, data.problem.epochs, data.truth.shape) == (batch, epochs, truth)


@pytest.mark.data
@pytest.mark.parametrize(("name", "options"), [("uwb", {"flight": "F01"}), ("plaza", {"form": "affine"})])
def test_the_truth_explains_the_rows(data_dir, name, options):
    data = datasets.load(name, folder=data_dir, **options)
    off = data.problem.observed - optloc.engine.predict(data.problem, data.truth.ravel())
    sigma = np.sqrt(variances(data.problem.noise, data.problem.count))
    assert np.median(np.abs(off) / sigma) < 0.9  # 0.67 of Gaussian errors
    assert np.abs(np.median(off / sigma)) < 0.3


@pytest.mark.data
def test_all_sets_are_there_and_say_where_they_come_from(data_dir):
    assert datasets.available(data_dir) == datasets.NAMES
    for name, entry in ENTRIES.items():
        readme = (data_dir / entry.folder / "README.md").read_text(encoding="utf-8")
        licence = entry.licence.partition(" (")[0].replace("3-Clause", "").strip().lower()
        assert licence in readme.replace("**", "").lower(), name


@pytest.mark.data
def test_a_flight_of_ranges_is_no_flight_of_differences(data_dir):
    with pytest.raises(InvalidProblem, match="has ranges, not differences; use F01, F02"):
        datasets.load("uwb", folder=data_dir, flight="F07")
    with pytest.raises(InvalidProblem, match="flight: 'F1' is unknown; did you mean"):
        datasets.load("uwb", folder=data_dir, flight="F1")
