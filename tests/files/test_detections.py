"""Events of opensoundscape: delays relative to the first receiver give the source, and clips are refused."""

import math

import numpy as np
import pandas as pd
import pytest

import optloc
from optloc import InvalidProblem
from optloc.files.convert import convert
from optloc.files.csv_formats import read_table
from optloc.files.wave_speed import WaveOptions

SOUND = 343.0
RECEIVERS = {
    "a_652_1.wav": (0.0, 0.0),
    "a_652_2.wav": (20.0, 2.0),
    "a_652_3.wav": (18.0, 25.0),
    "a_652_4.wav": (-3.0, 21.0),
}
SOURCES = ((7.0, 9.0), (12.0, 30.0))


def events(form):
    """Return events as `events_to_df` writes them to CSV: arrays of numpy, or lists."""
    wrap = np.array if form == "arrays" else list
    rows = []
    for source in SOURCES:
        times = [math.dist(source, at) / SOUND for at in RECEIVERS.values()]
        rows.append(
            {
                "receiver_files": wrap([f"/data/rec/{name}" for name in RECEIVERS]),
                "receiver_locations": wrap([list(at) for at in RECEIVERS.values()]),
                "max_delay": 0.1,
                "tdoas": wrap([round(time - times[0], 6) for time in times]),
                "cc_maxs": wrap([1.0, 0.4, 0.3, 0.5]),
                "start_timestamp": "2021-09-24 06:00:00-04:00",
                "class_name": "BTNW",
            }
        )
    return pd.DataFrame(rows)


@pytest.mark.parametrize("form", ["arrays", "lists"])
def test_events_give_their_sources(form, tmp_path):
    events(form).to_csv(tmp_path / "events.csv")
    table = read_table(tmp_path / "events.csv")
    assert table.count == 8
    assert table.labels("station").tolist()[:2] == ["a_652_1.wav", "a_652_2.wav"]
    wave = WaveOptions(speed=f"{SOUND} m/s")
    made = convert(tmp_path / "events.csv", tmp_path / "events.toml", sigma="0.1 ms", wave=wave)
    fixes = optloc.solve(optloc.load(made.written[0]))
    assert fixes.position == pytest.approx(np.array(SOURCES), abs=0.05)


def test_events_without_delays_are_left_out_with_a_note(tmp_path):
    table = events("lists").astype({"tdoas": object})
    table.at[0, "tdoas"] = None
    table.to_csv(tmp_path / "events.csv")
    assert read_table(tmp_path / "events.csv").notes == (
        "events without delays are left out: 1; add their delays to use them",
    )
    table["tdoas"] = None
    table.to_csv(tmp_path / "events.csv")
    with pytest.raises(InvalidProblem, match="no event has delays; run estimate_location of opensoundscape"):
        read_table(tmp_path / "events.csv")


def test_lists_of_different_lengths_name_the_row(tmp_path):
    table = events("lists").astype({"tdoas": object})
    table.at[1, "tdoas"] = [0.0, 0.01]
    table.to_csv(tmp_path / "events.csv")
    with pytest.raises(InvalidProblem, match=r"row 2: the event has 4 receivers, 2 delays and 8 coordinates"):
        read_table(tmp_path / "events.csv")


def test_detections_in_clips_have_no_arrivals(tmp_path):
    (tmp_path / "detections.csv").write_text("file,start_time,end_time,BTNW\n/data/a.wav,0.0,3.0,1\n")
    with pytest.raises(InvalidProblem, match="detections in clips, which have no arrival times; estimate") as error:
        read_table(tmp_path / "detections.csv")
    assert len(str(error.value)) <= 200
