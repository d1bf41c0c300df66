"""Data sets of the tests: times of arrival of six receivers in the plane."""

import numpy as np
import pandas as pd

C = 0.299792458  # metres per nanosecond
ANGLE = np.arange(6) * np.pi / 3
PLACE = np.stack([5e3 * np.cos(ANGLE) * (1 + 0.1 * np.arange(6)), 5e3 * np.sin(ANGLE)], axis=1)
STATIONS = {f"R{i}": tuple(xy) for i, xy in enumerate(PLACE.tolist())}
SIGMA = "30 ns"


def arrivals(first, count, seed=0):
    """Return a long table of events from number `first` on, and their true positions (count, 2)."""
    rng = np.random.default_rng([seed, first])
    truth = rng.uniform(-4e3, 4e3, (count, 2))
    delay = np.linalg.norm(PLACE - truth[:, None], axis=-1) / C + rng.normal(0.0, 20.0, (count, 6))
    number = np.arange(first, first + count)
    times = (1790000000000000000 + number * 10**7)[:, None] + np.round(delay).astype(np.int64)
    table = {"message": np.repeat(number, 6), "station": np.tile(list(STATIONS), count), "toa_ns": times.ravel()}
    return pd.DataFrame(table), truth


def wide(first, count):
    """Return a table with a column of ranges for each receiver, in metres, and the true positions."""
    rng = np.random.default_rng([1, first])
    truth = rng.uniform(-4e3, 4e3, (count, 2))
    ranges = np.linalg.norm(PLACE - truth[:, None], axis=-1) + rng.normal(0.0, 5.0, (count, 6))
    columns = {f"range_{name}_m": ranges[:, i] for i, name in enumerate(STATIONS)}
    return pd.DataFrame({"event": np.arange(first, first + count)} | columns), truth


def write(folder, parts=3, count=20):
    """Write a data set of long tables and the table of its stations, and return the paths of both."""
    folder.mkdir()
    for i in range(parts):
        arrivals(i * count, count)[0].to_parquet(folder / f"part-{i}.parquet", index=False)
    sites = folder.with_name("sites.csv")
    pd.DataFrame([(name, *xy) for name, xy in STATIONS.items()], columns=["name", "x", "y"]).to_csv(sites, index=False)
    return folder, sites
