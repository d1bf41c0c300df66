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
from fuzz.surfaces import renamed, stream_case, study_case, table_case
from pyarrow import parquet

# Of forty cases. Methods of a study run in a process of their own, which takes its time.
FAMILIES = ("problem",) * 15 + ("table",) * 11 + ("stream",) * 6 + ("convert",) * 4 + ("folder",) * 3 + ("study",)
# Those that have their own originals and commands.
SURFACES = {"table": table_case, "stream": stream_case, "folder": study_case}
# Levels of a document and of a table, the likelier ones often.
DOCUMENT = ("bytes", "tokens", "tokens", "structure", "structure", *("graft",) * 3, *("rows",) * 6)
TABLE = ("bytes", "tokens", "columns", "columns", "columns", "columns")
PLAIN, TREE = ("bytes", "tokens", "tokens"), ("bytes", "tokens", "tokens", *("structure",) * 4, "rows")
LINES = ("jsonl", "ndjson")
LEVELS = (
    dict.fromkeys(("csv", "tsv"), TABLE)
    | dict.fromkeys(("json", "geojson", "state", *LINES), TREE)
    | {"toml": DOCUMENT}
)

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
    if family in SURFACES:
        original, held, arguments, asked = SURFACES[family](rng)
        first = next(iter(held))
    elif family == "convert":
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
        name = rng.choice([first if first in held else next(iter(held)), *held])
        level, held[name] = mutated(rng, name, held[name], family)
        done.append(f"{level} of {name}")
        # A part file is called by what is in it: half of the time it is called so again.
        if family == "folder" and name.startswith("out/parts/") and rng.random() < 0.5:
            data = held.pop(name)
            held[renamed(name, data)] = data
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
    level = rng.choice(LEVELS.get(suffix, PLAIN))
    text = data.decode(errors="replace")
    if level == "bytes":
        return _bytes(rng, data)
    if level == "tokens":
        chosen = rng.choice(m.TOKENS)
        return chosen.__name__, chosen(rng, text).encode("utf-8", "surrogatepass")
    if level == "columns":
        separator = max(",;\t", key=text.partition("\n")[0].count)
        rows = [line.split(separator) for line in text.splitlines() if line] or [[""]]
        chosen = rng.choice(m.COLUMNS)
        return chosen.__name__, m.csv_text(rng, chosen(rng, rows)).encode(rng.choice(m.ENCODINGS), "replace")
    return _tree(rng, suffix, text, level, family) or _bytes(rng, data)


def _tree(rng, suffix, text, level, family):
    """Return what was done to the data of a document, and the document; None of one that earlier mutations broke."""
    lines = text.splitlines() if suffix in LINES else [text]
    at = rng.randrange(len(lines)) if lines else 0
    try:
        tree = tomllib.loads(text) if suffix == "toml" else json.loads(lines[at])
    except (ValueError, RecursionError, IndexError):
        return None
    if not isinstance(tree, dict | list):
        return None
    if level == "graft":
        chosen, done = partial(m.graft, other=rng.choice(grafts("problem" if family == "stream" else family))), "graft"
    else:
        chosen = rng.choice(m.ROWS if level == "rows" else m.STRUCTURE)
        done = chosen.__name__
    # Mutations of rows look for lists of this name.
    rows = level == "rows" and isinstance(tree, list)
    tree = chosen(rng, {"rows": tree})["rows"] if rows else chosen(rng, tree)
    lines[at] = m.toml_text(tree) if suffix == "toml" else json.dumps(tree)
    return done, "\n".join(lines).encode("utf-8", "surrogatepass")


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
