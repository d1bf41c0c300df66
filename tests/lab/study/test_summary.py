"""What is right, wrong and falsely proven, on a table made by hand; names, order, ranking."""

import numpy as np
import pandas as pd
import pytest
from lab.study.rows import hand_made, row

from optloc.lab.study.summary import by_status, case_label, cells, instances, judged, methods, noise_text, ranking


@pytest.fixture
def frame():
    return hand_made()


def test_rows_are_judged_by_what_is_known(frame):
    table = frame.set_index(["method", "trial"])
    assert table["right"].loc["a"].tolist() == [True, True, False, False]
    assert table["right"].loc["b"].tolist() == [True, False, False, True]
    assert table["wrong"].loc["a"].tolist() == [False, False, True, False]
    assert table["wrong"].loc["b"].tolist() == [False, True, False, False]
    assert table["false"].loc["a"].tolist() == [False, False, True, False]
    assert table["false"].loc["b"].tolist() == [False, True, False, False]


def test_cells_count_and_average(frame):
    table = cells(frame).set_index("method")
    assert table.loc["a", ["trials", "answered", "right", "wrong", "proven", "false"]].tolist() == [4, 3, 2, 1, 2, 1]
    assert table.loc["b", ["trials", "answered", "right", "wrong", "proven", "false"]].tolist() == [4, 4, 2, 1, 1, 1]
    assert table.loc["a", ["rmse", "bound", "ratio", "nees"]].tolist() == [2.0, 2.0, 1.0, 1.0]


def test_counts_by_status_say_where_a_better_point_is_known(frame):
    names = ["method", "status", "trials", "right", "better", "wrong"]
    assert by_status(frame)[names].to_numpy().tolist() == [
        ["a", "ok", 3, 2, 1, 1],
        ["a", "singular geometry", 1, 0, 0, 0],  # without a cost nothing is better
        ["b", "ok", 3, 2, 1, 1],
        ["b", "ambiguous", 1, 0, 1, 0],  # a better point is known, and the status says that there may be one
    ]
    # all fixes are counted once, and what was wrong but ok is that of the other tables
    made = frame.assign(status=np.where(frame["status"] == "ok", "unproven", frame["status"]))
    table = by_status(judged(made.drop(columns=["above", "right", "wrong", "false", "case"])))
    assert table["trials"].sum() == len(frame)
    assert table["wrong"].sum() == 0
    assert table["better"].sum() == by_status(frame)["better"].sum() == 3


def test_a_method_that_claims_nothing_is_judged_by_its_positions():
    rows = pd.DataFrame([row("bare", i, 5.0 + i, status="unavailable", error=4.0) for i in range(3)])
    found = cells(judged(rows.assign(gap=0.0)))
    assert found["answered"].tolist() == [0]
    assert found["right"].tolist() == [0]
    assert found["ratio"].tolist() == [2.0]


def test_ranking_punishes_failures_and_takes_common_instances_only(frame):
    order = methods(frame)
    assert order == ["a", "b"]  # equally often right, but quicker
    times, solved, total = instances(frame[~((frame["method"] == "b") & (frame["trial"] == 0))], order)
    assert times.shape == solved.shape == (2, 3)
    assert total == 4
    table = ranking(frame, order, 0.0).set_index("method")
    limit = 10 * 2e-3
    assert table.loc["a", "mean"] == pytest.approx((1e-3 * 1e-3 * limit * limit) ** 0.25)
    assert table.loc["b", "mean"] == pytest.approx((2e-3 * 2e-3 * limit * limit) ** 0.25)
    assert table.loc[["a", "b"], "fastest"].tolist() == [0.5, 0.25]


def test_names_are_for_people_and_sorted_so():
    assert case_label("in", "{}") == "in"
    assert case_label("in", '{"truth.distance": ["8 km", "12 km"], "layout.stations": 6}') == (
        "in, distance 8 km to 12 km, stations 6"
    )
    assert noise_text('{"tdoa": "10 m", "groa": "1 dB"}') == "tdoa 10 m, groa 1 dB"
    assert (noise_text("30 ns"), noise_text("0.5")) == ("30 ns", "noise × 0.5")
    rows = [row("a", 0, 1.0, sweep=f'{{"layout.stations": {n}}}', data=str(n)) for n in (12, 5, 8)]
    found = judged(pd.DataFrame(rows).assign(gap=0.0))
    assert list(found["case"].cat.categories) == ["s, stations 5", "s, stations 8", "s, stations 12"]
