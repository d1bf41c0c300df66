"""Mutations of files: functions of a random generator and a text (bytes, lines, tokens, cells) or data (structure).

Each is pure and takes its chances from `random.Random` only, whose numbers are the same everywhere, so a case is made
again from its seed and number alone.
"""

import copy
import json
import math
import re
from datetime import date, datetime, time

# What stands in the place of a number. Zero and one, the ends of floats and integers, what is none, what is none yet.
NUMBERS = (
    "0", "-0.0", "1", "-1", "2", "0.5", "90", "-90", "180", "360", "1e-12", "1e-308", "5e-324", "1e12", "1e20", "1e154",
    "1e155", "1e300", "1e308", "-1e308", "1.7976931348623157e308", "1e400", "-1e400", "nan", "inf", "-inf", "NaN",
    "9007199254740993", "9223372036854775807", "9223372036854775808", "18446744073709551616", "-2147483649",
    "9" * 400, "7" * 4301, "1_000", "0x10", "0b1", "1e", "+-1", "1,5", "1.5.2", "--1", "٣", "1979-05-27",
    "2024-02-30T25:61:00Z", "true", '"1"', '""', '"nan"', '"1e308 m"', '"-5 ns"', "[]", "{}", "[1, 2]", "None", "1e3",
)  # fmt: skip
# The same that any reader takes for a number.
FINITE = (
    0.0, -0.0, 1.0, -1.0, 2.0, 0.5, 3.0, 10.0, 89.9, 90.0, 180.0, 1e-9, 1e-6, 1e-3, 1e3, 1e5, 1e7, 1e9, 1e12, 1e20,
    1e50, 1e-30, 1e-160, 5e-324, 1e100, 1e150, -1e155, 1e200, 1e300, 1.7976931348623157e308, -1e308,
)  # fmt: skip
FACTORS = (-1.0, 0.0, 0.1, 0.999, 1.001, 10.0, 1e3, 1e6, 1e-6, 1e-12, 1e12, 1e100, 1e-100, 1e200, 1e300)
# What stands in the place of a word.
WORDS = (
    "", " ", "A", "a ", "0", "1.0", "nan", "None", "true", "-", "../x", "/etc/passwd", "=1+1", "@SUM(A1)", "$x^2$", "$",
    "%s %d %", "{0}", "\\", "\\n", "\u00e4\u00f6", "\u540d", "\U0001f4e1", "e\u0301",
    "\u202ex", "\u200b", "\x00", "\x1b[31m", "\x85",
    "a" * 300, "a" * 5000, "[bold]x[/bold]", "[/]", "<script>", "&amp;", "'", '"', "a,b", "a;b", "a\tb", "a\nb",
    "estimate",
    "position", "position[0]", "emission", "all", "target", "known", "free", "free_velocity", "static",
    "constant_velocity", "drift",
    "scale", "rotation", "pair", "kind", "ecef", "enu", "geodetic", "cartesian", "north-clockwise", "b-farther", "run",
    "north-counterclockwise", "2026-06-01", "4 deg",
    "tdoa", "toa", "range", "range_sum", "groa", "azimuth", "elevation", "height", "range_rate", "fdoa",
    "rss_difference", "auto",
    "estimate ", "1 ns", "10 m", "-3 m", "0 m", "1e308 km", "1e-320 ps", "nan m", "5 parsec", "3 dB", "2 deg", "1 Hz",
)  # fmt: skip
UNITS = (
    "m", "km", "cm", "mm", "ft", "yd", "mi", "nmi", "s", "ms", "us", "ns", "ps", "rad", "mrad", "deg", "arcmin",
    "arcsec",
    "1", "dB", "Np", "m/s", "km/s", "km/h", "ft/s", "mph", "kn", "Hz", "min", "h", "M", "", "%",
)  # fmt: skip

# Bytes.


def flip(rng, data):
    """Change some bits."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        if out:
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def delete(rng, data):
    """Leave some bytes out."""
    start = rng.randrange(len(data) + 1)
    return data[:start] + data[start + _short(rng) :]


def insert(rng, data):
    """Put in some bytes."""
    start = rng.randrange(len(data) + 1)
    new = rng.choice([b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"\r", b"\n", b'"', b",", b"#", b"]", rng.randbytes(8)])
    return data[:start] + new + data[start:]


def truncate(rng, data):
    """End early."""
    return data[: rng.randrange(len(data) + 1)]


def duplicate(rng, data):
    """Have a piece twice."""
    start = rng.randrange(len(data) + 1)
    end = min(start + 4 * _short(rng), len(data))
    return data[:end] + data[start:end] + data[end:]


def splice(rng, data, other):
    """Begin as one file and end as another."""
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]


def _short(rng):
    return rng.choice([1, 1, 2, 5, 20, 100])


# Lines and tokens.


def lines(rng, text):
    """Drop, repeat, swap or move a line."""
    rows = text.split("\n")
    i, j = rng.randrange(len(rows)), rng.randrange(len(rows))
    what = rng.choice(["drop", "repeat", "swap", "move"])
    if what == "repeat":
        rows.insert(j, rows[i])
    elif what == "swap":
        rows[i], rows[j] = rows[j], rows[i]
    else:
        row = rows.pop(i)
        if what == "move":
            rows.insert(j, row)
    return "\n".join(rows)


_NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d_]*(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])")
_QUOTED = re.compile(r'"[^"\n]*"')
_KEY = re.compile(r"\b([A-Za-z_]+)(?= *=)")


def number(rng, text):
    """Put a hostile number in the place of one, or of several."""
    known = rng.choice([NUMBERS, FINITE])
    return _replace(rng, _NUMBER, text, lambda old: str(rng.choice(known)))


def every_number(rng, text):
    """Multiply all numbers, or give them many digits."""
    factor = rng.choice([0.0, -1.0, 1e-150, 1e-9, 1e9, 1e150, 1e300])
    return _NUMBER.sub(lambda m: repr(float(m[0].replace("_", "")) * factor), text)


def word(rng, text):
    """Put another word in the place of a quoted one: hostile, a unit, or one of the same text."""
    own = [m[0] for m in _QUOTED.finditer(text)] or ['""']
    kind = rng.choice([lambda: json.dumps(rng.choice(WORDS), ensure_ascii=False), lambda: rng.choice(own)])
    return _replace(rng, _QUOTED, text, lambda old: kind())


def unit(rng, text):
    """Put a unit in the place of a quoted word, a unit where there is one."""
    known = re.compile("|".join(f'"{re.escape(u)}"' for u in UNITS if u))
    return _replace(rng, known if known.search(text) else _QUOTED, text, lambda old: f'"{rng.choice(UNITS)}"')


def key(rng, text):
    """Put another key in the place of one."""
    own = [m[0] for m in _KEY.finditer(text)] or ["x"]
    return _replace(rng, _KEY, text, lambda old: rng.choice([*own, "unit", "epoch", "time", "weight", "sigma", "file"]))


def quotes(rng, text):
    """Make a number a word, or a word bare."""
    if rng.random() < 0.5:
        return _replace(rng, _NUMBER, text, lambda old: f'"{old}"')
    return _replace(rng, _QUOTED, text, lambda old: old.strip('"'))


def _replace(rng, pattern, text, new):
    """Replace one match, or a few."""
    found = list(pattern.finditer(text))
    for match in sorted(rng.sample(found, min(len(found), rng.choice([1, 1, 1, 2, 5]))), key=lambda m: -m.start()):
        text = text[: match.start()] + new(match[0]) + text[match.end() :]
    return text


# Structure: data of TOML or JSON.


def remove(rng, data):
    """Leave out a key or an entry."""
    place, at = _any(rng, data)
    if place is not None:
        del place[at]
    return data


def empty(rng, data):
    """Empty a table or a list."""
    place, at = _any(rng, data)
    if place is not None:
        place[at] = type(place[at])() if isinstance(place[at], dict | list | str) else rng.choice(["", [], {}])
    return data


def lengthen(rng, data):
    """Repeat the entries of a list."""
    found = [(p, k) for p, k in _places(data) if isinstance(p[k], list) and p[k]]
    if found:
        place, at = rng.choice(found)
        place[at] = place[at] * rng.choice([2, 3, 40])
    return data


def exchange(rng, data):
    """Put what stands in one place in another."""
    (one, here), (two, there) = _any(rng, data), _any(rng, data)
    if one is not None and two is not None:
        new = copy.deepcopy(two[there])
        one[here] = new
    return data


def nest(rng, data):
    """Wrap something in a list or a table, or deeply."""
    place, at = _any(rng, data)
    if place is not None:
        for _ in range(rng.choice([1, 1, 2, 40])):
            place[at] = [place[at]] if rng.random() < 0.5 else {"x": place[at]}
    return data


def change(rng, data):
    """Put something of another type, or a hostile number or word, in a place."""
    place, at = _any(rng, data)
    if place is not None:
        numbers = (0, -1, 2, 7, 2**53 + 1, 2**63, 10**400, 0.0, -0.0, 1e-308, 1e155, 1e308, math.nan, math.inf, 0.5)
        place[at] = rng.choice([rng.choice(numbers), rng.choice(WORDS), rng.choice(UNITS), True, [], {}, [[1.0]]])
    return data


def graft(rng, data, other):
    """Take over a key of another file, or one that belongs there."""
    place, at = _any(rng, other)
    if place is None or not isinstance(data, dict):
        return data
    # A table takes what one like it has; else something goes to the top.
    if not isinstance(place, dict) or rng.random() < 0.3:
        place, at = other, rng.choice(sorted(other))
    tables = [data] if place is other else [p[k] for p, k in _places(data) if isinstance(p[k], dict)] or [data]
    likely = sorted(tables, key=lambda t: len(set(t) & set(place)))[-3:]
    new = copy.deepcopy(place[at])
    # Of many constraints, biases ... one at a time: that several fit together is rare.
    if isinstance(new, list) and new and isinstance(new[0], dict) and at not in ("rows", "measurements"):
        new = [rng.choice(new)]
    into = rng.choice(likely)
    into[at] = _own_names(rng, data, new)
    return data


def _own_names(rng, data, new):
    """Return what is grafted with the names of stations of the file that it comes to, where it holds others."""
    rows = [p[k] for p, k in _places(data) if k == "name" and isinstance(p[k], str)]
    strange = {p[k] for p, k in _places([new]) if isinstance(p[k], str) and p[k] in _NAMES}
    names = {name: rng.choice(rows) if rows else name for name in sorted(strange)}
    for place, at in _places([new]):
        if isinstance(place[at], str):
            place[at] = names.get(place[at], place[at])
        elif isinstance(place[at], dict) and set(place[at]) & strange:
            place[at] = {names.get(key, key): value for key, value in place[at].items()}
    return new


_NAMES = {"North", "East", "South", "West", "Hill", "Tower", "A", "B", "C", "D", "E", "G04", "Lake", "Transmitter"}


# Rows: what a file that can be read still says wrongly.

COLUMNS_OF_ROWS = (
    "time", "epoch", "weight", "sigma", "target", "correction", "x", "y", "z", "vx", "vy", "vz", "yaw_deg",
    "heading_deg",
    "kind", "a", "b", "name", "height", "lat_deg", "lon_deg", "qw",
)  # fmt: skip


def values(rng, data):
    """Let one value of a column, or all, be a multiple of what they were, or another number."""
    rows, column = _column(rng, data, float | int)
    for row in rows:
        row[column] = float(row[column]) * rng.choice(FACTORS) if rng.random() < 0.5 else rng.choice(FINITE)
    return data


def scaled(rng, data):
    """Let a column be a multiple of what it was, or of one value."""
    rows, column = _column(rng, data, float | int, share=0.0)
    factor, constant, level = rng.choice(FACTORS), rng.choice(FINITE), rng.random() < 0.3
    for row in rows:
        row[column] = constant if level else float(row[column]) * factor
    return data


def words(rng, data):
    """Let a word of some rows be one of others."""
    rows, column = _column(rng, data, str)
    own = [row[column] for row in _column(rng, data, str)[0] if isinstance(row.get(column), str)]
    for row in rows:
        row[column] = rng.choice(own or ["A"])
    return data


def new_column(rng, data):
    """Give all rows of a table one column more."""
    tables = _tables(data)
    if tables:
        name = rng.choice(COLUMNS_OF_ROWS)
        make = rng.choice(
            [
                lambda i: i // 3,
                lambda i: float(i // 4),
                lambda i: 1.0,
                lambda i: rng.choice(FINITE),
                lambda i: rng.choice(["one", "two"]),
                lambda i: 0.5 * (i % 3),
            ]
        )
        for i, row in enumerate(rng.choice(tables)):
            row[name] = make(i)
    return data


def fewer_rows(rng, data):
    """Leave rows out, have them twice or in another order."""
    tables = _tables(data)
    if tables:
        rows = rng.choice(tables)
        if rng.random() < 0.4:
            rng.shuffle(rows)
        elif rng.random() < 0.7:
            del rows[: rng.randrange(len(rows))]
        else:
            rows.append(dict(rng.choice(rows)))
    return data


def setting(rng, data):
    """Let a number of a setting be another one, which its unit keeps."""
    found = [(p, k) for p, k in _places(data) if isinstance(p[k], float | str) and _AMOUNT.fullmatch(str(p[k]))]
    if found:
        place, at = rng.choice(found)
        _, unit = _AMOUNT.fullmatch(str(place[at])).groups()
        number = rng.choice(FINITE)
        place[at] = f"{number!r}{unit}" if isinstance(place[at], str) else number
    return data


_AMOUNT = re.compile(r"([-+]?[\d.]+(?:e[-+]?\d+)?)((?: [^ ]+)?)")


def _tables(data):
    return [p[k] for p, k in _places(data) if k == "rows" and isinstance(p[k], list) and p[k] and _uniform(p[k])]


def _uniform(rows):
    return all(isinstance(row, dict) for row in rows)


def _column(rng, data, kind, share=0.7):
    """Return some of the rows of a table, or all, and a column in which they have a value of a type."""
    tables = [(rows, c) for rows in _tables(data) for c in rows[0] if isinstance(rows[0][c], kind)]
    if not tables:
        return [], ""
    rows, column = rng.choice(tables)
    rows = [row for row in rows if isinstance(row.get(column), kind) and not isinstance(row[column], bool)]
    return (rng.sample(rows, min(len(rows), rng.randint(1, 3))) if rng.random() < share else rows), column


def _places(data):
    """Return all (container, key) of nested data."""
    found, level = [], [data]
    while level:
        inner = level.pop()
        keys = list(inner) if isinstance(inner, dict) else range(len(inner)) if isinstance(inner, list) else ()
        for k in keys:
            found.append((inner, k))
            level.append(inner[k])
    return found


def _any(rng, data):
    """Return a place: as likely a table or list as one of their numbers, of which there are many."""
    found = _places(data)
    large = [(p, k) for p, k in found if isinstance(p, dict) and not isinstance(p[k], str | int | float)]
    keys = [(p, k) for p, k in found if isinstance(p, dict) and len(_places(data)) and "name" not in p]
    chosen = rng.choice([found, large, keys])
    return rng.choice(chosen or found) if found else (None, None)


def toml_text(value):
    """Return data as TOML: a line for each key, tables inline."""
    return "\n".join(f"{_word(k)} = {_toml(v)}" for k, v in value.items()) + "\n"


def _toml(value):
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_word(k)} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, date | datetime | time):
        return value.isoformat()
    return _word(value) if isinstance(value, str) else repr(value)


def _word(text):
    # As JSON, where DEL may stand unescaped.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


# Columns: cells of CSV as rows of text.


def drop_column(rng, rows):
    """Leave a column out."""
    at = rng.randrange(max(map(len, rows)))
    return [row[:at] + row[at + 1 :] for row in rows]


def swap_columns(rng, rows):
    """Exchange two columns, with or without their names."""
    i, j = (rng.randrange(min(map(len, rows)) or 1) for _ in range(2))
    out = [list(row) for row in rows]
    for row in out[rng.randrange(2) :]:
        if max(i, j) < len(row):
            row[i], row[j] = row[j], row[i]
    return out


def rename_column(rng, rows):
    """Rename a column: as another one, with blanks, or hostile."""
    head = list(rows[0]) or [""]
    at = rng.randrange(len(head))
    head[at] = rng.choice(
        [head[at].upper(), f" {head[at]} ", *head, *WORDS, "weight", "sigma", "time", "epoch", "target"]
    )
    return [head, *rows[1:]]


def shuffle_rows(rng, rows):
    """Have the rows in another order."""
    return [rows[0], *rng.sample(rows[1:], len(rows) - 1)]


def repeat_rows(rng, rows):
    """Have some rows again, or many times."""
    return rows + rng.choices(rows[1:] or rows, k=rng.choice([1, 3, 1000]))


def ragged(rng, rows):
    """Let rows have more or fewer cells."""
    out = [list(row) for row in rows]
    for _ in range(rng.randint(1, 3)):
        row = rng.choice(out)
        row.append(rng.choice(WORDS)) if rng.random() < 0.5 or not row else row.pop()
    return out


def cell(rng, rows):
    """Put something hostile in cells, or in a whole column."""
    out = [list(row) for row in rows]
    at = rng.randrange(max(map(len, rows)) or 1)
    own = [row[at] for row in out[1:] if at < len(row)] or [""]
    new = rng.choice(
        [
            *(str(rng.choice(FINITE)) for _ in range(4)),
            rng.choice(NUMBERS),
            rng.choice(WORDS),
            rng.choice(own),
            "",
            " ",
            "2024-05-01T00:00:00Z",
        ]
    )
    chosen = out[1:] if rng.random() < 0.2 else rng.sample(out, min(len(out), rng.randint(1, 3)))
    for row in chosen:
        if at < len(row):
            row[at] = new
    return out


def csv_text(rng, rows):
    """Return rows as CSV, in one of its many ways."""
    separator = rng.choice([","] * 12 + [";", "\t", "|", " "])
    quote = rng.choice(["{}"] * 12 + ['"{}"', "'{}'", " {} "])
    text = rng.choice(["\n"] * 12 + ["\r\n", "\r", "\n\n"]).join(
        separator.join(quote.format(cell) for cell in row) for row in rows
    )
    return rng.choice(["", "", "", "\ufeff"]) + text + rng.choice(["\n", "\n", ""])


def more_columns(rng, rows):
    """Have one column more."""
    new = new_column(rng, {"rows": [{} for _ in rows[1:]] or [{}]})["rows"]
    name = next(iter(new[0]))
    return [[*rows[0], name], *([*row, str(given[name])] for row, given in zip(rows[1:], new, strict=False))]


ENCODINGS = ("utf-8",) * 20 + ("latin-1", "utf-16", "utf-8-sig", "cp1252")

BYTES = (flip, delete, insert, truncate, duplicate)
TOKENS = (lines, number, number, every_number, word, word, unit, key, quotes)
ROWS = (values, values, scaled, words, new_column, new_column, fewer_rows, setting, setting)
STRUCTURE = (remove, empty, lengthen, exchange, nest, change, change)
COLUMNS = (drop_column, swap_columns, rename_column, shuffle_rows, repeat_rows, ragged, cell, cell, cell, more_columns)
