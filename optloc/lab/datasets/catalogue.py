"""Table of the data sets that optloc reads, and the functions that load them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from inspect import signature
from pathlib import Path
from types import MappingProxyType
from typing import Any

from optloc.lab.datasets.reading import check_files, root
from optloc.problem import Array, InvalidProblem, Problem, nearest


@dataclass(frozen=True, slots=True)
class Dataset:
    """Real measurements as a problem, with the truth.

    Parameters
    ----------
    name : str
        Name in `NAMES`.
    problem : Problem
        In SI units. Each epoch, or each problem of its batch, is to be fixed.
    truth : array (..., d)
        True position of each epoch, of each problem of the batch, or of each target, metres in the problem's frame.
    description : str
        Measurements, site and accuracy of the truth.
    source : str
        Origin of the data.
    licence : str
        Licence of the data.
    """

    name: str
    problem: Problem
    truth: Array
    description: str
    source: str
    licence: str


@dataclass(frozen=True, slots=True)
class DatasetEntry:
    """Entry of the table of data sets.

    `folder` is the folder of the files, and `sha256` are the SHA-256 of the files by name. The other fields are those
    of `Dataset`.
    """

    folder: str
    description: str
    source: str
    licence: str
    sha256: Mapping[str, str]

    def reader(self, name: str) -> Callable[..., tuple[Problem, Array]]:
        """Return the function that reads the set: `dataset` of the module `name`."""
        return import_module(f"optloc.lab.datasets.{name}").dataset  # type: ignore[no-any-return]


# SHA-256 of the files that produced the numbers of the documentation.
_ENTRIES = {
    "uwb": DatasetEntry(
        "util_uwb_tdoa",
        "Indoor UWB range differences of a quadrotor in a hall of 7 x 8 x 3.5 m with eight anchors; six flights, with "
        "and without obstacles. Truth: motion capture, millimetres.",
        "github.com/utiasDSL/util-uwb-dataset; data paper: International Journal of Robotics Research 43(10), 2024",
        "none stated (public research data, citation requested)",
        {
            "flights.csv": "25986fa76e36703a8b51cd18ef101650943506e8e49a3bfff552a32902ac5a35",
            "ranges.csv": "bc2e5fdf46c93034d5baf86e11610e161d769693e23796a1258c44e75d32c73d",
            "stations.csv": "a88bde1440cac4fde197c492aaf13969c31e1e1c7d1ed0b7c1fd0f861dc45e20",
            "tdoa.csv": "ef0619087965ae5546c409bae7365ec4ef632f54709018a3bf2878f0bf8f2b8f",
            "truth.csv": "33a769190cc4103768f34fe7f4c3fcdbef0e43071dcb2fcd9e65eeff2605f39b",
        },
    ),
    "adsb": DatasetEntry(
        "locards_adsb",
        "Arrival times of 763 messages of airliners, each received by five of 27 receivers 9 to 322 km away, with the "
        "aircraft's height. Truth: the report of the aircraft, tens of metres.",
        "Schaefer, Strohmeier, Leonardi, Lenders: LocaRDS, Sensors 21(16), 2021 (Zenodo 4739276), by way of "
        "github.com/lschoe/mpyc, demos/data/mlat",
        "CC-BY-SA",
        {
            "measurements.csv": "e47532645e2605c7b02242cc9928ccb2ab6e33f56d8b14c6482723861ef9e58b",
            "stations.csv": "fc41c5db97621e0512543fb31027e08bf17dbd5881e861d20207519d7a87ce3f",
            "truth.csv": "8fae66dc3449377316b7837ab7e6b35754e969fa4006ed1eb151b9ff4ae9012a",
        },
    ),
    "gnss": DatasetEntry(
        "gnss_static",
        "Pseudoranges of GPS, Galileo and QZSS to two fixed antennas in Japan. Truth: surveyed, centimetres.",
        "K078: github.com/hirokawa/cssrlib-data; N176: github.com/taroz/MatRTKLIB",
        "MIT",
        {
            "measurements.csv": "6681a4db6af39117abe9afe9b6dfd7abbc767b0f18b4ea93289380b40cf86264",
            "truth.csv": "6e816bd029bcd40a3a3898eee2efd3844f752a472d612fb51c565863d1929f68",
        },
    ),
    "mrclam": DatasetEntry(
        "mrclam_aoa2d",
        "Bearings and ranges between a robot and 15 landmarks in the plane, 0.9 to 10 m. Truth: motion capture.",
        "Leung, Halpern, Barfoot, Liu: International Journal of Robotics Research 30(8), 2011, by way of "
        "github.com/sunglok/TriangulationToolbox",
        "BSD 2-Clause",
        {
            "measurements.csv": "94618b2ab564d6efba2721413a23011bd70319439007bb05720433577f5c92c4",
            "stations.csv": "68b9bca0a568f502fcd73332bc7c4610d44ac8077b6e6ba2dc7349e42e51698d",
            "truth.csv": "66ff5b65253ff23b29e6d9e82db70a9726881f30630f775b0abc8e924dd87a19",
        },
    ),
    "plaza": DatasetEntry(
        "plaza_range",
        "Radio ranges of 5 to 75 m between a mower and four beacons on a plaza, 7 % too long. Truth: GPS, centimetres.",
        "Djugash: Geolocation with range, CMU range-only data sets, by way of github.com/borglab/gtsam",
        "BSD 3-Clause",
        {
            "ranges.csv": "891d3a2df61e29cea7a6b57cdfc250c017cc1e2fab3014ae5e144b6ee63aef48",
            "stations.csv": "69c626311636072237eace89ceabf2dcdc5f9d91c3da49d2d453bfc1455af7a7",
            "truth.csv": "52d7fda0aca2ebf3fd20bc70679c78f490fa63d3927b20914562a81f7bfdef2a",
        },
    ),
    "starloc": DatasetEntry(
        "starloc_aoa",
        "Azimuths and elevations of markers in a room, by a moving camera whose mount is turned by 0.7 or 9.6 deg. "
        "Truth: motion capture, centimetres.",
        "github.com/utiasASRL/starloc; arXiv 2309.05518",
        "none stated (citation requested)",
        {
            "measurements.csv": "bdca52d81624da6f515db1d48d7a49677f200c53864f10dc352ede22036e0400",
            "runs.csv": "a08ea0460e1af21c9eed5233c752e9c6648cca77aaece2e51b86229fe785b129",
            "stations.csv": "5eef0eb58eb6afc2070349b47f3eea26fc097d4bad5cd6bd7d84e09e4732d0dd",
            "truth.csv": "38e97e3642583766d234519af0bc60492487f9e37ba344b0b11fbe6507fe8e24",
        },
    ),
}
ENTRIES: Mapping[str, DatasetEntry] = MappingProxyType(_ENTRIES)

NAMES = tuple(_ENTRIES)
"""Names of all data sets that optloc can read."""


def available(folder: str | Path | None = None) -> tuple[str, ...]:
    """Return the names of the data sets whose files exist; an empty tuple if no folder is set.

    Parameters
    ----------
    folder : str or Path, optional
        Folder that contains one folder for each set; by default the value of the variable OPTLOC_DATA.
    """
    try:
        # Only the existence of the files is tested: `load` checks their sums.
        path = root(folder)
    except InvalidProblem:
        return ()
    return tuple(
        name for name, entry in ENTRIES.items() if all((path / entry.folder / file).is_file() for file in entry.sha256)
    )


def load(name: str, *, folder: str | Path | None = None, verify: bool = True, **options: Any) -> Dataset:
    """Return a data set as a problem with its truth.

    Parameters
    ----------
    name : str
        One of `NAMES`.
    folder : str or Path, optional
        Folder that contains one folder for each set; by default the value of the variable OPTLOC_DATA.
    verify : bool
        Whether to require, by SHA-256, the same files that produced the numbers of the documentation.
    **options
        Part and form of the set; see the page of the data sets.

    Raises
    ------
    InvalidProblem
        If no folder is set, a file is missing or has another SHA-256, or an option is unknown.
    """
    if name not in ENTRIES:
        raise InvalidProblem(f"there is no data set {name!r}", "datasets.load", nearest(name, NAMES))
    entry = ENTRIES[name]
    read = entry.reader(name)
    known = list(signature(read).parameters)[1:]  # without the first, the folder
    for option in options:
        if option not in known:
            raise InvalidProblem(f"the data set {name!r} has no option {option!r}", "options", nearest(option, known))
    place = root(folder) / entry.folder
    if verify:
        check_files(place, entry.sha256)
    problem, truth = read(place, **options)
    return Dataset(name, problem, truth, entry.description, entry.source, entry.licence)
