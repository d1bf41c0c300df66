"""Selection files: candidates, places, measurements and rules; output of the chosen sites as a problem file.

Letters: P places, s stations (candidates and existing stations), m rows, d coordinates.

Arguments of many functions: `section` is a table of the file, and `folder` is the folder of the file.
`source` or `where` is the location in the file for error messages. `frame` and `dimension` belong to the
coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from formulations.placement import PlacementGround, PlacementRegion
from optloc.files import (
    DataTable,
    FrameTable,
    MeasurementsTable,
    PriorTable,
    SoundTable,
    SpeedTable,
    StationsTable,
    Table,
    Units,
    assemble,
    claim,
    distinct,
    join,
    kind_model,
    name_of,
    of_rows,
    parse_toml,
    read_text,
    settle_frame,
    survey,
    table_of,
    toml_text,
    validate,
    validated,
    within,
    write_text,
)
from optloc.problem import Amount, Array, Frame, InvalidProblem, Problem, check_once, nearest
from optloc.sites.placement.areas import (
    convex_parts,
    corners_in_frame,
    ground_of,
    inside,
    polygons_of,
    region_of,
    visible,
)
from optloc.sites.placement.sites import CountGroup, Name, SiteSelection

# Columns of stations and candidates that a problem file accepts.
_PLACE = (
    "x",
    "y",
    "z",
    "lat_deg",
    "lon_deg",
    "height",
    "vx",
    "vy",
    "vz",
    "qw",
    "qx",
    "qy",
    "qz",
    "azimuth",
    "tilt",
    "roll",
)
# Keys for the source of rows.
_ROWS = {"file", "rows", "columns", "separator"}
# Largest number of places in an area.
_MANY = 10_000


class _SelectionTable(BaseModel):
    """A table of the selection file; unknown keys are an error."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class ChoiceTable(_SelectionTable):
    """Number of sites, criterion and limits of the search."""

    choose: int | None = Field(default=None, ge=1)
    """Number of candidates to take, in addition to existing stations."""
    budget: float | None = Field(default=None, ge=0.0)
    """Largest total cost of the new stations; candidates need a column cost."""
    criterion: Literal["rms", "volume", "axis"] = "rms"
    """Mean-square error (A), determinant (D) or largest eigenvalue (E) of the covariance of the position."""
    worst: bool = False
    """Use the maximum over the places, instead of the weighted mean."""
    fail_one: bool = False
    """Use the value after the worst loss of one station."""
    gap: float = Field(default=0.01, gt=0.0, lt=1.0)
    """Relative gap between value and bound at which the search stops."""
    time: float = Field(default=60.0, gt=0.0)
    """Time limit of the search, seconds."""
    alternatives: int = Field(default=5, ge=1, le=100)
    """Number of best sets in the result."""
    kept: list[str] = Field(default_factory=list)
    """Candidates that are always taken; `choose` does not count them."""
    forbidden: list[str] = Field(default_factory=list)
    """Candidates that are never taken."""
    seed: int = Field(default=0, ge=0)
    """Seed of the random sets."""


class TargetsTable(DataTable):
    """Places of interest. Columns: x, y, z or lat_deg, lon_deg, height; name, weight. Or an area with a spacing."""

    unit: str = "m"
    """Unit of x, y, z and height."""
    polygon: str | None = None
    """GeoJSON file with a polygon: longitude and latitude in a geodetic frame, otherwise metres of the frame."""
    spacing: Amount | None = None
    """Distance between neighbouring places in the area."""
    height: Amount | None = None
    """Height, or third coordinate, of the places in the area."""


class ExpectedTable(MeasurementsTable):
    """Expected measurements, as in a problem file but without values; the default is one row per station."""

    range_max: Amount | None = None
    """Largest distance of a measurement."""


class SightTable(DataTable):
    """Lines of sight. Columns: candidate, place, sight (0, 1 or a factor on sigma); the default of a pair is 1."""

    terrain: str | None = None
    """CSV file with columns x, y, z on a grid, metres of the frame: terrain that blocks lines of sight."""


class GroupTable(_SelectionTable):
    """A rule for the number of candidates from a group, for instance of one mast, region or owner."""

    group: str | None = None
    """Word in the column group of the members."""
    members: list[str] | None = None
    """Names of the members, instead of a word."""
    most: int | None = Field(default=None, ge=0)
    """Largest number of members to take."""
    least: int | None = Field(default=None, ge=0)
    """Smallest number of members to take."""


class RefineTable(_SelectionTable):
    """Region of the stations during continuous refinement."""

    polygon: str
    """GeoJSON file with a polygon."""
    height: list[Amount] = Field(default=["0 m", "0 m"], min_length=2, max_length=2)
    """Smallest and largest height, or third coordinate; with a terrain, above the ground."""
    terrain: str | None = None
    """CSV file with columns x, y, z on a grid."""


class SelectionFile(_SelectionTable):
    """A site selection: candidates, places, measurements and rules."""

    format: Literal[1]
    """Version of the format."""
    title: str | None = None
    """Title of the selection."""
    propagation_speed: float | str | SoundTable | SpeedTable | None = None
    """As in a problem file."""
    frame: FrameTable = FrameTable()
    choice: ChoiceTable
    stations: StationsTable | None = None
    """Existing stations, which are kept."""
    candidates: StationsTable
    """Possible station sites. Columns as for stations; optional: cost, group, and sigma of their measurements."""
    targets: TargetsTable
    measurements: list[ExpectedTable] = Field(min_length=1)
    sight: SightTable | None = None
    groups: list[GroupTable] = Field(default_factory=list)
    priors: list[PriorTable] = Field(default_factory=list)
    """Priors of the target, such as its position; the default position is the area of stations and places."""
    refine: RefineTable | None = None


@dataclass(frozen=True, slots=True)
class LoadedSelection:
    """A site selection, and the other contents of its file.

    Parameters
    ----------
    selection : SiteSelection
        Candidates, places and rules.
    source, title : str
        Name of the file, and its title.
    settings : dict
        Tables of a problem file with all sites and their rows; `write_chosen` writes a part of them.
    regions : tuple of PlacementRegion
        Regions of the stations in the refinement; empty without a refinement.
    ground : PlacementGround, optional
        Terrain; with it, the heights of the regions are heights above the ground.
    """

    selection: SiteSelection
    source: str
    title: str
    settings: dict[str, Any]
    regions: tuple[PlacementRegion, ...] = ()
    ground: PlacementGround | None = None


def is_selection(path: Path) -> bool:
    """Return whether a file is a selection file: it has a table [choice] or [candidates]."""
    found = parse_toml(read_text(path), name_of(path), formats=(1, 2))
    return "choice" in found or "candidates" in found


def read_selection(path: Path) -> LoadedSelection:
    """Return the site selection of a file.

    Raises
    ------
    InvalidProblem
        If the file is invalid; the message names file, row and column or key.
    """
    source, folder = name_of(path), path.parent
    file = validated(SelectionFile, parse_toml(read_text(path), source), source)
    candidates = table_of(_data_only(file.candidates), folder, join(source, "[candidates]"))
    tables = [(candidates, file.candidates)]
    if file.stations is not None:
        tables.append((table_of(_data_only(file.stations), folder, join(source, "[stations]")), file.stations))
    names = [table.labels("name").tolist() for table, _ in tables]
    check_once([name for own in names for name in own], "station name {!r} is used twice", source)
    settings = _problem_tables(file, tables, folder, source)
    made = validate(settings, source)
    stations = of_rows(settings["stations"]["rows"], join(source, "[stations]"), {})
    rows = [table_of(m, folder, join(source, f"[[measurements]] {i + 1}")) for i, m in enumerate(made.measurements)]
    problem = assemble(made, stations, rows, source, values=False).loaded.problem
    wanted = settle_frame(file.frame, problem.frame, problem.dimension)
    settings["frame"] = wanted.model_dump(exclude_none=True)
    places, labels, weights = _places(file.targets, wanted, problem, folder, source)
    choice = file.choice
    selection = SiteSelection(
        problem,
        places,
        weights,
        choice.choose,
        choice.budget,
        _candidate_column(candidates, "cost", problem) if choice.budget is not None else None,
        (*(names[1] if len(names) > 1 else ()), *choice.kept),
        tuple(choice.forbidden),
        tuple(
            _count_group(group, candidates, join(source, f"[[groups]] {i + 1}")) for i, group in enumerate(file.groups)
        ),
        choice.criterion,
        choice.worst,
        choice.fail_one,
        _sight_factors(file.sight, problem, places, labels, folder, source),
        _range_limits(file, [len(table.columns["a"]) for table in rows], source),
        choice.gap,
        choice.time,
        choice.alternatives,
        "station",
        labels,
        choice.seed,
    )
    regions, ground = _regions(file.refine, problem.frame, problem.dimension, folder, source)
    return LoadedSelection(selection, source, file.title or source, settings, regions, ground)


def _data_only(section: StationsTable) -> DataTable:
    """Return a station section with only the keys for the source of its rows."""
    return DataTable(file=section.file, rows=section.rows, columns=section.columns, separator=section.separator)


def _problem_tables(
    file: SelectionFile, tables: Sequence[tuple[Table, StationsTable]], folder: Path, source: str
) -> dict[str, Any]:
    """Return the tables of a problem file with all stations and the rows that each station would have.

    `tables` are the candidates and then, if the file has them, the existing stations; each with its section
    of the file. `folder` is the folder of the file, and `source` is its name for messages.
    """
    units = {(section.unit, section.speed_unit) for _, section in tables}
    if len(units) > 1:
        raise InvalidProblem("stations and candidates have different units", source, "use the same unit for both")
    keys = [key for key in _PLACE if any(table.has(key) for table, _ in tables)]
    rows: list[dict[str, Any]] = []
    for table, section in tables:
        # This call only checks the coordinates: the column sigma belongs to measurements, so it is removed.
        survey(section.model_copy(update={"sigma": None}), _without_sigma(table), file.frame, table.source)
        for i, name in enumerate(table.labels("name")):
            rows.append({"name": str(name)} | {key: float(table.numbers(key)[i]) for key in keys if table.has(key)})
    sigmas = {str(n): v for n, v in zip(*_candidate_sigmas(tables[0][0]), strict=True)}
    station = file.candidates.model_dump(exclude_defaults=True, exclude=_ROWS)
    measurements = []
    for i, expected in enumerate(file.measurements):
        given = expected.model_dump(exclude_defaults=True, exclude=_ROWS | {"range_max"})
        place = join(source, f"[[measurements]] {i + 1}")
        measurements.append(given | {"rows": _expected_rows(expected, rows, sigmas, folder, place)})
        # If the candidates have a column sigma, each row has a sigma, and a common one would conflict.
        if sigmas:
            measurements[-1].pop("sigma", None)
    out = {
        "format": 1,
        "title": file.title,
        "propagation_speed": file.propagation_speed
        if not isinstance(file.propagation_speed, SoundTable | SpeedTable)
        else file.propagation_speed.model_dump(),
        "frame": file.frame.model_dump(exclude_none=True),
        "stations": station | {"rows": rows},
        "measurements": measurements,
        "priors": [prior.model_dump(exclude_none=True) for prior in file.priors],
    }
    return {key: value for key, value in out.items() if value is not None and value != []}


def _without_sigma(table: Table) -> Table:
    """Return the table without its column sigma, which describes measurements here, not positions."""
    columns = {name: column for name, column in table.columns.items() if name != table.name("sigma")}
    return replace(table, columns=columns)


def _candidate_sigmas(table: Table) -> tuple[Sequence[str], Sequence[float]]:
    """Return names and sigmas of the candidates, in the unit of the measurements; empty without a column sigma."""
    if not table.has("sigma"):
        return (), ()
    return table.labels("name").tolist(), table.numbers("sigma").tolist()


def _expected_rows(
    section: ExpectedTable, stations: Sequence[dict[str, Any]], sigmas: dict[str, float], folder: Path, where: str
) -> list[dict[str, Any]]:
    """Return the rows that a section lists; without a list, one row for each station except its second station.

    Each row is a dict with the columns of a problem file. `stations` are the rows of the stations. `sigmas` maps
    a candidate to the sigma of its measurements, if the candidates have this column.
    """
    if section.kind is None:
        raise InvalidProblem("the key 'kind' is missing", where, 'write kind = "toa"')
    kind_model(section.kind, join(where, "key 'kind'"))
    if section.file is not None or section.rows is not None:
        table = table_of(section, folder, where)
        keys = [key for key in ("a", "b", "sigma", "weight", "correction") if table.has(key)]
        found = [{key: table.raw(key)[i] for key in keys} for i in range(table.count)]
        return [{key: v.item() if isinstance(v, np.generic) else v for key, v in row.items()} for row in found]
    made = []
    for station in stations:
        if station["name"] not in (section.a, section.b):
            row: dict[str, Any] = {"a": station["name"]}
            if sigmas:
                sigma = sigmas.get(station["name"])
                if sigma is None and section.sigma is None:
                    raise InvalidProblem(
                        f"station {station['name']!r} has no sigma", where, "give sigma for all stations"
                    )
                row["sigma"] = sigma if sigma is not None else float(str(section.sigma).split()[0])
            made.append(row)
    return made


def _candidate_column(candidates: Table, key: str, problem: Problem) -> Array:
    """Return the candidate column `key` (s,) for all s stations of the problem, 0 for existing stations."""
    given = dict(zip(candidates.labels("name").tolist(), candidates.numbers(key).tolist(), strict=True))
    return np.array([given.get(name, 0.0) for name in problem.stations.names])


def _count_group(table: GroupTable, candidates: Table, where: str) -> CountGroup:
    """Return the rule of a group table, with the names of its members; `where` is its location for messages."""
    if (table.group is None) == (table.members is None):
        raise InvalidProblem("a group needs either the key group or the key members", where, "give one of the two")
    if table.most is None and table.least is None:
        raise InvalidProblem("the group has no rule", where, "give most or least")
    if table.members is not None:
        return CountGroup(tuple(table.members), table.most, table.least)
    words = [str(word) for word in candidates.raw("group")]
    if table.group not in words:
        what = f"no candidate is in group {table.group!r}"
        raise InvalidProblem(what, where, nearest(str(table.group), sorted({*words})))
    labels = candidates.labels("name")
    members = tuple(str(name) for name, word in zip(labels, words, strict=True) if word == table.group)
    return CountGroup(members, table.most, table.least)


def _places(
    section: TargetsTable, wanted: FrameTable, problem: Problem, folder: Path, source: str
) -> tuple[Array, tuple[str, ...], Array | None]:
    """Return places (P, d), metres, their names, and their weights (P,); the weights are None if they are equal.

    The places are the rows of the section, or a grid in its polygon. `wanted` is the frame of their
    coordinates. The names default to P1, P2 and so on.
    """
    where = join(source, "[targets]")
    if section.polygon is not None:
        if section.file is not None or section.rows is not None or section.spacing is None:
            raise InvalidProblem(
                "an area needs a polygon and a spacing, without rows or file", where, 'write spacing = "5 m"'
            )
        points = _grid_in_polygon(section, problem.frame, problem.dimension, folder, where)
        return points, tuple(f"P{i + 1}" for i in range(len(points))), None
    table = table_of(section, folder, where)
    if not table.has("name"):
        labels = np.array([f"P{i + 1}" for i in range(table.count)], dtype=object)
        table = replace(table, columns={**table.columns, table.name("name"): labels})
    found = survey(StationsTable(unit=section.unit), _without_sigma(table), wanted, table.source)[0]
    _, first, _ = distinct(table.labels("name"))
    if len(first) < table.count:
        raise InvalidProblem("two places have the same name", table.source, "give each place a different name")
    weights = None
    if table.has("weight"):
        weights = table.numbers("weight")
        bad = np.flatnonzero(weights <= 0.0)
        if len(bad):
            what = f"the weight {weights[bad[0]]:g} is not positive"
            raise InvalidProblem(what, table.where("weight", int(bad[0])), "give a weight above 0, or leave it out")
    return found.position, found.names, weights


def _grid_in_polygon(section: TargetsTable, frame: Frame, dimension: int, folder: Path, where: str) -> Array:
    """Return places (P, d) on a square grid inside a polygon, metres; P is at most `_MANY`."""
    assert section.polygon is not None
    step = Units("length").plain(section.spacing or 0.0, section.unit, join(where, "key 'spacing'"))
    if not step > 0.0:
        raise InvalidProblem(f"the spacing {step:g} m is not positive", where, 'write spacing = "5 m"')
    height = 0.0 if section.height is None else Units("length").plain(section.height, section.unit, where)
    rings = [
        corners_in_frame(r, frame, where)
        for r in polygons_of(within(folder, section.polygon, join(where, "key 'polygon'")))
    ]
    low, high = np.min([r.min(0) for r in rings], axis=0), np.max([r.max(0) for r in rings], axis=0)
    if np.prod((high - low) / step + 1.0) > _MANY:
        raise InvalidProblem(f"the spacing {step:g} m gives more than {_MANY} places", where, "use a larger spacing")
    axes = [np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    points = grid[np.any([inside(grid, ring) for ring in rings], axis=0)]
    if not len(points):
        raise InvalidProblem("with this spacing, the area contains no place", where, "use a smaller spacing")
    return points if dimension == 2 else np.column_stack([points, np.full(len(points), height)])


def _range_limits(file: SelectionFile, counts: Sequence[int], source: str) -> Array | None:
    """Return the largest range (m,) at which each row is measured, metres; None if no section has a limit.

    `counts` are the numbers of rows of the sections. The m rows are in the order of the assembled problem.
    """
    if all(section.range_max is None for section in file.measurements):
        return None
    # `assemble` orders the blocks of rows by the first appearance of their kind and joins equal kinds
    kinds: dict[str, list[float]] = {}
    for i, (section, count) in enumerate(zip(file.measurements, counts, strict=True)):
        place = join(source, f"[[measurements]] {i + 1}", "key 'range_max'")
        most = np.inf if section.range_max is None else Units("length").plain(section.range_max, "m", place)
        if not most > 0.0:
            raise InvalidProblem(f"the range {most:g} m is not positive", place, "give a positive range")
        kinds.setdefault(str(section.kind), []).extend([most] * count)
    return np.concatenate([np.array(values) for values in kinds.values()])


def _sight_factors(
    section: SightTable | None, problem: Problem, places: Array, labels: Sequence[str], folder: Path, source: str
) -> Array | None:
    """Return the sight factor (P, s) of each place and station, 0 if out of sight; None if all pairs are in sight.

    The factor multiplies sigma. `places` (P, d) are positions, metres, and `labels` are their names.
    """
    if section is None:
        return None
    where, names = join(source, "[sight]"), problem.stations.names
    # Terrain and table are multiplied: a pair that the terrain blocks stays out of sight.
    out = np.ones((len(places), len(names)))
    if section.terrain is not None:
        ground = ground_of(within(folder, section.terrain, join(where, "key 'terrain'")), join(where, "key 'terrain'"))
        out *= visible(ground, places, problem.stations.position.reshape(-1, problem.dimension))
    if section.file is None and section.rows is None:
        return out
    table = table_of(section, folder, where)
    values = table.numbers("sight")
    for key, known in (("candidate", names), ("place", labels)):
        for row, label in enumerate(table.labels(key)):
            if label not in known:
                raise InvalidProblem(f"there is no {key} {label!r}", table.where(key, row), nearest(label, list(known)))
    bad = np.flatnonzero(~((values == 0.0) | (values >= 1.0)))
    if len(bad):
        what = f"the sight {values[bad[0]]:g} is neither 0 nor at least 1"
        raise InvalidProblem(
            what,
            table.where("sight", int(bad[0])),
            "give 0 for out of sight, 1 for in sight, or a larger factor on sigma",
        )
    site, place = {n: i for i, n in enumerate(names)}, {n: i for i, n in enumerate(labels)}
    for one, other, value in zip(table.labels("candidate"), table.labels("place"), values, strict=True):
        out[place[other], site[one]] *= value
    return out


def _regions(
    section: RefineTable | None, frame: Frame, dimension: int, folder: Path, source: str
) -> tuple[tuple[PlacementRegion, ...], PlacementGround | None]:
    """Return the convex regions of the refinement, and its terrain (None without); no region without a section."""
    if section is None:
        return (), None
    where = join(source, "[refine]")
    low, high = (Units("length").plain(v, "m", join(where, "key 'height'")) for v in section.height)
    if low > high:
        raise InvalidProblem(
            "the first height is above the second", join(where, "key 'height'"), "swap the two heights"
        )
    path = within(folder, section.polygon, join(where, "key 'polygon'"))
    parts = [part for ring in polygons_of(path) for part in convex_parts(corners_in_frame(ring, frame, where))]
    ground = None
    if section.terrain is not None and dimension == 3:
        ground = ground_of(within(folder, section.terrain, join(where, "key 'terrain'")), join(where, "key 'terrain'"))
    return tuple(region_of(part, low, high) for part in parts), ground


def write_chosen(loaded: LoadedSelection, taken: Sequence[str], out: Path, source: Path) -> None:
    """Write a problem file with the taken stations and their rows, as input of `crlb --map` and studies.

    `taken` are the names of the stations. Second stations of rows are written too. `source` is the selection
    file, which must not be overwritten by `out`.
    """
    if out.suffix.lower() != ".toml":
        raise InvalidProblem("the output is a problem file, so its name must end in .toml", str(out), "change the name")
    claim(out, inputs=[source])
    kept, settings = {*taken}, dict(loaded.settings)
    # `others` are the second stations of sections of rows.
    others = {s.get("b") for s in settings["measurements"]}
    stations = [row for row in settings["stations"]["rows"] if row["name"] in kept | others]
    settings["stations"] = settings["stations"] | {"rows": stations}
    rows = [[row for row in section["rows"] if row["a"] in kept] for section in settings["measurements"]]
    settings["measurements"] = [
        section | {"rows": chosen_rows}
        for section, chosen_rows in zip(settings["measurements"], rows, strict=True)
        if chosen_rows
    ]
    settings["title"] = f"{loaded.title}: the chosen stations"
    text = "format = 1\n" + toml_text({key: value for key, value in settings.items() if key != "format"})
    write_text(out, text)


def criterion_name(name: str) -> Name:
    """Return the name of a criterion, or raise InvalidProblem if it is unknown."""
    known: tuple[Name, ...] = ("rms", "volume", "axis")
    for one in known:
        if name == one:
            return one
    raise InvalidProblem(f"there is no criterion {name!r}", "--criterion", nearest(name, list(known)))
