"""A case: the mutated files of one original, and the command that is run on them; made of a seed and a number alone."""

import io
import json
import random
import tomllib
from dataclasses import dataclass
from functools import partial

import pyarrow as pa
from fuzz import mutations as m
from fuzz.originals import conversions, grafts, problems, studies
from pyarrow import parquet

# Of twenty cases fourteen are problems. Methods of a study run in a process of their own, which takes its time.
FAMILIES = ("problem",) * 14 + ("convert",) * 4 + ("study",) * 2
# Levels of a document and of a table, the likelier ones often.
DOCUMENT = ("bytes", "tokens", "tokens", "structure", "structure", *("graft",) * 3, *("rows",) * 6)
TABLE = ("bytes", "tokens", "columns", "columns", "columns", "columns")

COMMANDS = (
    *[(("fix", "--json"), ())] * 8,
    (("fix",), ()),
    (("fix", "-m", "robust", "--json"), ()),
    (("fix", "-m", "gtrs+lsr", "--geojson", "-"), ()),
    (("fix", "--out", "f.csv"), ("f.csv",)),
    (("fix", "--height", "500 m", "--json"), ()),
    (("fix", "--noise-from-data", "station", "--json"), ()),
    (("check",), ()),
    (("check", "--json"), ()),
    (("check", "--out", "h.parquet"), ("h.parquet",)),
    (("crlb", "--json"), ()),
    (("crlb", "--at", "1500,900,400"), ()),
    (("track", "--json"), ()),
    (("track", "--model", "csm", "--filter", "ekf", "--out", "t.csv"), ("t.csv",)),
    (("simulate", "--truth", "1500,900,400", "--out", "s.toml"), ("s.toml", "s-*.csv")),
    (("simulate", "--truth", "1500,900", "--trials", "3", "--out", "s.toml"), ("s.toml", "s-*.csv")),
    (("separate", "--json"), ()),
    (("plot", "fix", "--out", "p.svg"), ("p.svg",)),
)


@dataclass(frozen=True)
class Case:
    """Files as they are written, and a command."""

    number: int
    family: str
    original: str
    done: tuple
    files: dict
    arguments: tuple
    asked: tuple

    @property
    def name(self):
        return f"{self.number}: {' '.join(self.arguments)} on {self.original} after {', '.join(self.done)}"


def case_of(seed, number):
    """Return a case."""
    rng = random.Random(f"{seed} {number}")
    family = rng.choice(FAMILIES)
    if family == "convert":
        original = rng.choice(sorted(conversions()))
        held, more, asked = conversions()[original]
        first = next(iter(held))
        arguments = ("convert", first, *more)
    else:
        known = problems() if family == "problem" else studies()
        original = rng.choice(sorted(known))
        held = known[original]
        first = next(iter(held))
        arguments, asked = _command(rng, family, first)
    held, done = dict(held), []
    for _ in range(rng.choice([1, 1, 1, 2, 2, 3])):
        name = rng.choice([first, *held])
        level, held[name] = mutated(rng, name, held[name], family)
        done.append(f"{level} of {name}")
    return Case(number, family, original, tuple(done), held, arguments, asked)


def _command(rng, family, first):
    if family == "study":
        return ("study", "run", first, "--trials", "2", "--out", "out", "-j", "1", "-q"), ("out", "out/*")
    (verb, *more), asked = rng.choice(COMMANDS)
    # The picture's name stands before the file.
    return ((verb, more[0], first, *more[1:]) if verb == "plot" else (verb, first, *more)), asked


def mutated(rng, name, data, family):
    """Return what was done to a file, and the file."""
    suffix = name.rpartition(".")[2]
    if suffix == "parquet":
        level = rng.choice(["bytes", "columns", "columns"])
        return (level, _packed(rng, data)) if level == "columns" else _bytes(rng, data)
    level = rng.choice(TABLE if suffix == "csv" else DOCUMENT)
    text = data.decode(errors="replace")
    if level == "bytes":
        return _bytes(rng, data)
    if level == "tokens":
        chosen = rng.choice(m.TOKENS)
        return chosen.__name__, chosen(rng, text).encode("utf-8", "surrogatepass")
    if level == "columns":
        rows = [line.split(",") for line in text.splitlines() if line] or [[""]]
        chosen = rng.choice(m.COLUMNS)
        return chosen.__name__, m.csv_text(rng, chosen(rng, rows)).encode(rng.choice(m.ENCODINGS), "replace")
    # What an earlier mutation has broken has no structure any more.
    try:
        tree = json.loads(text) if suffix == "geojson" else tomllib.loads(text)
    except (ValueError, RecursionError):
        return _bytes(rng, data)
    if not isinstance(tree, dict):
        return _bytes(rng, data)
    if level == "graft" and suffix == "toml":
        chosen = partial(m.graft, other=rng.choice(grafts(family)))
        done = "graft"
    else:
        chosen = rng.choice(m.ROWS if level == "rows" else m.STRUCTURE)
        done = chosen.__name__
    tree = chosen(rng, tree)
    return done, (json.dumps(tree) if suffix == "geojson" else m.toml_text(tree)).encode("utf-8", "surrogatepass")


def _bytes(rng, data):
    other = rng.choice(sorted(problems()))
    chosen = rng.choice([*m.BYTES, partial(m.splice, other=next(iter(problems()[other].values())))])
    return getattr(chosen, "__name__", "splice"), chosen(rng, data)


def _packed(rng, data):
    """Return a Parquet table whose rows are mutated as those of CSV are, or whose columns have other types."""
    try:
        table = parquet.read_table(io.BytesIO(data), use_threads=False)
    except (pa.ArrowException, OSError):
        return data
    if rng.random() < 0.6:
        at = rng.randrange(table.num_columns)
        table = table.set_column(at, table.column_names[at], _retyped(rng, table.column(at).to_pylist()))
    else:
        rows = [table.column_names, *([str(cell) for cell in row.values()] for row in table.to_pylist())]
        rows = rng.choice(m.COLUMNS)(rng, rows)
        width = max(map(len, rows))
        columns = [[row[i] if i < len(row) else None for row in rows] for i in range(width)]
        table = pa.table([_column(cells[1:]) for cells in columns], [str(cells[0]) for cells in columns])
    out = io.BytesIO()
    parquet.write_table(table, out)
    return out.getvalue()


def _column(cells):
    try:
        return pa.array([None if cell is None else float(cell) for cell in cells])
    except ValueError:
        return pa.array([None if cell is None else cell.encode("utf-8", "replace").decode() for cell in cells])


def _retyped(rng, cells):
    hostile = (None, float("nan"), float("inf"), 1e308, -1e308, 0.0, 2.0**63)
    return rng.choice(
        [
            lambda: pa.array([str(cell) for cell in cells]),
            lambda: pa.array([str(cell) for cell in cells]).dictionary_encode(),
            lambda: pa.array([[1.0]] * len(cells)),
            lambda: pa.array([None] * len(cells)),
            lambda: pa.array([True] * len(cells)),
            lambda: pa.array([b"x"] * len(cells)),
            lambda: pa.array([i * 10**9 for i in range(len(cells))], pa.timestamp(rng.choice(["s", "ns"]))),
            lambda: pa.array([rng.choice(hostile) for _ in cells], pa.float64()),
            lambda: pa.array([i % 3 for i in range(len(cells))], pa.int8()),
            lambda: pa.array([2**63 + i for i in range(len(cells))], pa.uint64()),
            lambda: pa.array([float(i) for i in range(len(cells))], pa.float32()),
            lambda: pa.array([{"a": 1}] * len(cells)),
        ]
    )()
