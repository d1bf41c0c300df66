"""Many epochs as a data frame; the answer has its index."""

import pandas as pd

import optloc

anchors = {"A": (0.0, 0.0), "B": (8.0, 0.0), "C": (0.0, 6.0), "D": (8.0, 6.0)}
times = pd.date_range("2026-05-01", periods=3, freq="1s")
table = pd.DataFrame(
    {"A": [5.0, 5.1, 5.2], "B": [5.0, 4.9, 4.8], "C": [5.0, 5.1, 5.1], "D": [5.0, 4.9, 4.8]}, index=times
)
fix = optloc.locate(anchors, ranges=table, sigma=0.05)
answer: pd.DataFrame = fix.to_dataframe()
print(answer.index.equals(times), (fix.statuses == optloc.Status.OK).sum())
