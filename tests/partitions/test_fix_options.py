"""Options of all partitions: stations in any form, and a record that changes with each of them."""

import json

import pytest
from partitions.scenes import SIGMA, STATIONS, write

from optloc import InvalidProblem
from optloc.files.constraint_table import constraint_of_text
from optloc.files.table_import import ColumnHints
from optloc.partitions.fix_options import FixOptions, check_shared, hints_of, identity_of


def test_hints_have_the_wave_and_the_stations_in_one_form(tmp_path):
    hints = hints_of(str(tmp_path / "sites.csv"), {"sigma": SIGMA, "wave_speed": "343 m/s", "two_way": True})
    assert (hints.stations, hints.sigma) == (tmp_path / "sites.csv", SIGMA)
    assert (hints.wave.speed, hints.wave.two_way) == ("343 m/s", True)
    assert hints_of(STATIONS, {}).stations.count == len(STATIONS)
    with pytest.raises(InvalidProblem, match="did you mean 'wave_speed'"):
        hints_of(None, {"wave_sped": "343 m/s"})


def test_only_options_that_read_one_event_alone_are_shared():
    check_shared(ColumnHints(sigma=SIGMA))
    with pytest.raises(InvalidProblem, match="--sigma: each partition would have another sigma"):
        check_shared(ColumnHints(sigma="estimate"))


def test_the_record_changes_with_every_option_and_with_the_content_of_files(tmp_path):
    _, sites = write(tmp_path / "readings", 1, 1)
    box = constraint_of_text("box min=[-1e4,-1e4] max=[1e4,1e4]", "box")
    variants = [
        FixOptions(ColumnHints(stations=sites, sigma=SIGMA)),
        FixOptions(ColumnHints(stations=sites, sigma="31 ns")),
        FixOptions(ColumnHints(stations=sites, sigma=SIGMA), "gtrs+lsr"),
        FixOptions(ColumnHints(stations=sites, sigma=SIGMA), more={"box": box}),
        FixOptions(hints_of(sites, {"sigma": SIGMA, "wave_speed": "343 m/s"})),
    ]
    records = [json.dumps(identity_of(one)) for one in variants]
    assert len(set(records)) == len(variants)
    sites.write_text(sites.read_text().replace("5000", "5001"))
    assert json.dumps(identity_of(variants[0])) != records[0]
