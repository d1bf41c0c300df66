"""Problem files with one mistake each, and the words that the complaint must hold."""

STATIONS = {"A": (0.0, 0.0, 30.0), "B": (4000.0, 300.0, 0.0), "C": (200.0, 5000.0, 80.0), "D": (4100.0, 4700.0, 10.0)}
HEAD = """format = 1
[stations]
rows = [
  { name = "A", x = 0.0, y = 0.0, z = 30.0 },
  { name = "B", x = 4000.0, y = 300.0, z = 0.0 },
  { name = "C", x = 200.0, y = 5000.0, z = 80.0 },
  { name = "D", x = 4100.0, y = 4700.0, z = 10.0 },
]
"""
TDOA = [("B", "A", 120.5), ("C", "A", -33.25), ("D", "A", 710.0)]


def write(folder, text, name="p.toml", **files):
    for stem, content in files.items():
        (folder / f"{stem}.csv").write_text(content, encoding="utf-8")
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def inline(rows):
    return "rows = [" + ", ".join(f'{{ a = "{a}", b = "{b}", z = {z!r} }}' for a, b, z in rows) + "]\n"


def tdoa(rows=TDOA, extra="sigma = 3.0\n", head=HEAD):
    return f'{head}[[measurements]]\nkind = "tdoa"\n{extra}{inline(rows)}'


GEODETIC = """format = 1
[frame]
{frame}
[stations]
rows = [
  {{ name = "A", lat_deg = 47.0, lon_deg = 11.0, height = 500.0 }},
  {{ name = "B", lat_deg = 47.1, lon_deg = 11.1, height = 600.0 }},
  {{ name = "C", lat_deg = 47.2, lon_deg = 10.9, height = 700.0 }},
]
[[measurements]]
kind = "azimuth"
unit = "deg"
azimuth = "north-clockwise"
sigma = 1.0
rows = [{{ a = "A", z = 45.0 }}, {{ a = "B", z = 0.0 }}]
"""


ROWS = HEAD + '[[measurements]]\nkind = "tdoa"\nsigma = 1.0\n'
BAD = {
    "missing file": (HEAD + '[[measurements]]\nkind = "tdoa"\nfile = "rowz.csv"\n', ["rowz.csv", "no such file"]),
    "folder": (HEAD + '[[measurements]]\nkind = "tdoa"\nfile = "."\n', ["folder"]),
    "unknown kind": (tdoa().replace('"tdoa"', '"tdaa"'), ["[[measurements]] 1", "tdaa", "did you mean 'tdoa'"]),
    "unknown unit": (tdoa(extra='unit = "nss"\nsigma = 1.0\n'), ["[[measurements]] 1", "nss", "did you mean 'ns'"]),
    "unit of another quantity": (tdoa(extra='unit = "deg"\nsigma = 1.0\n'), ["deg", "length"]),
    "wrong column": (
        HEAD + '[[measurements]]\nkind = "tdoa"\nsigma = 1.0\nfile = "ok.csv"\ncolumns = { z = "vale" }\n',
        ["ok.csv", "'vale'", "did you mean 'value'"],
    ),
    "nan": (ROWS + 'file = "nan.csv"\n', ["nan.csv", "row 2", "'z'"]),
    "infinite": (tdoa([*TDOA, ("C", "B", float("inf"))]), ["[[rows]] 4", "z is inf", "finite"]),
    "empty cell": (ROWS + 'file = "hole.csv"\n', ["hole.csv", "row 1", "'z'"]),
    "text": (ROWS + 'file = "text.csv"\n', ["text.csv", "row 2", "'1,5x'"]),
    "ragged": (ROWS + 'file = "ragged.csv"\n', ["ragged.csv", "row 2", "CSV", "expected 3 columns"]),
    "negative sigma": (tdoa(extra="sigma = -1.0\n"), ["sigma", "positive"]),
    "negative covariance": (
        tdoa(extra="covariance = [[1.0, 0, 0], [0, -2.0, 0], [0, 0, 1.0]]\n"),
        ["covariance", "(2, 2)", "-2"],
    ),
    "indefinite covariance": (tdoa(extra="covariance = [[1, 2, 0], [2, 1, 0], [0, 0, 1]]\n"), ["negative eigenvalue"]),
    "asymmetric covariance": (tdoa(extra="covariance = [[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]\n"), ["not symmetric"]),
    "ragged covariance": (tdoa(extra="covariance = [[1.0, 0.5], [0.5]]\n"), ["row 2", "covariance"]),
    "covariance of another size": (tdoa(extra="covariance = [[1.0]]\n"), ["covariance", "3 rows"]),
    "noise twice": (tdoa(extra="sigma = 1.0\narrival_sigma = 1.0\n"), ["more than once"]),
    "no noise": (tdoa(extra=""), ["no noise"]),
    "unknown station": (tdoa([("B", "Q", 1.0)]), ["row 1", "'b'", "no station 'Q'"]),
    "one station twice": (tdoa([("B", "A", 1.0), ("C", "C", 1.0)]), ["row 2", "twice"]),
    "duplicate station": (tdoa(head=HEAD.replace('"B"', '"A"')), ["[stations]", "row 2", "'A' is used twice"]),
    "mixed frames": (tdoa(head=HEAD.replace("x = 4000.0, y = 300.0", "lat_deg = 4.0, lon_deg = 3.0")), ["mix"]),
    "geodetic stations in a cartesian frame": (GEODETIC.format(frame='kind = "cartesian"'), ["cartesian"]),
    "frame without origin": (tdoa(head=HEAD.replace("[stations]", '[frame]\nkind = "enu"\n[stations]')), ["origin"]),
    "latitude": (GEODETIC.format(frame='kind = "ecef"').replace("47.1", "97.1"), ["row 2", "latitude 97.1"]),
    "empty file": ("", ["empty"]),
    "broken": ("format = 1\nstations = = 3\n", ["line 2", "TOML"]),
    "no format": ("title = 'x'\n", ["format = 2"]),
    "unknown format": ("format = 3\n", ["format 3"]),
    "unknown key": (tdoa(extra="sigma = 1.0\nwieght = 1.0\n"), ["]] 1", "'wieght'", "did you mean 'weight'"]),
    "unknown table": (tdoa() + "[statoins]\n", ["'statoins'", "did you mean 'stations'"]),
    "missing key": ("format = 1\n[stations]\nrows = []\n", ["'measurements' is missing"]),
    "wrong type": (tdoa(extra="sigma = true\n"), ["[[measurements]] 1", "sigma"]),
    "unknown choice": (tdoa(extra='sigma = 1.0\npositive = "b_farther"\n'), ["positive", "did you mean 'b-farther'"]),
    "bias without unit": (tdoa() + '[[biases]]\nname = "clock"\nsigma = 200.0\n', ["clock", "no unit", '"200.0 m"']),
    "unknown prior": (tdoa() + '[[priors]]\nname = "positon"\nmean = [0.0]\nsigma = 1.0\n', ["positon", "position"]),
    "no rows": (HEAD + '[[measurements]]\nkind = "tdoa"\nrows = []\n', ["no rows"]),
    "rows twice": (HEAD + '[[measurements]]\nkind = "tdoa"\nrows = []\nfile = "ok.csv"\n', ["once"]),
    "no parquet": (HEAD + '[[measurements]]\nkind = "tdoa"\nfile = "bad.parquet"\n', ["bad.parquet", "not Parquet"]),
    "unknown type of file": (HEAD + '[[measurements]]\nkind = "tdoa"\nfile = "ok.xlsx"\n', ["ok.xlsx", ".csv"]),
    "csv without text": (HEAD + '[[measurements]]\nkind = "tdoa"\nfile = "empty.csv"\n', ["empty.csv", "empty"]),
    "csv not utf-8": (HEAD + '[[measurements]]\nkind = "tdoa"\nfile = "latin.csv"\n', ["latin.csv", "line 2", "UTF-8"]),
    "column twice": (HEAD + '[[measurements]]\nkind = "tdoa"\nfile = "twice.csv"\n', ["twice.csv", "'z' occurs twice"]),
    "weight": (ROWS + 'file = "weight.csv"\n', ["row 1", "weight 7"]),
    "elevation in the plane": (
        ROWS.replace("tdoa", "elevation").replace(", z = ", ", vz = ") + 'rows = [{ a = "A", z = 1.0 }]\n',
        ["elevation", "2 dimensions"],
    ),
    "height without the Earth": (
        HEAD + '[[measurements]]\nkind = "height"\nsigma = 1.0\nrows = [{ z = 1.0 }]\n',
        ["height", "geodetic"],
    ),
    "moving target without times": (
        tdoa([*TDOA]).replace('{ a = "B"', '{ epoch = 2, a = "B"').replace('{ a = "C"', '{ epoch = 3, a = "C"')
        .replace('{ a = "D"', '{ epoch = 4, a = "D"') + '[target]\nmotion = "constant_velocity"\n',
        ["moving target", "time"],
    ),
}  # fmt: skip


def bad_files(folder):
    """Write the files that bad problems name."""
    files = {
        "ok": "a,b,value\nB,A,1\n",
        "nan": "a,b,z\nB,A,1\nC,A,nan\n",
        "hole": "a,b,z\nB,A,\nC,A,1\n",
        "text": 'a,b,z\nB,A,1\nC,A,"1,5x"\n',
        "ragged": "a,b,z\nB,A,1\nC,A,1,2\n",
        "twice": "a,b,z,z\nB,A,1,1\n",
        "weight": "a,b,z,weight\nB,A,1,7\n",
        "empty": "",
    }
    for stem, text in files.items():
        (folder / f"{stem}.csv").write_text(text)
    (folder / "latin.csv").write_bytes("a,b,z\nB,Ä,1\n".encode("latin-1"))
    (folder / "bad.parquet").write_bytes(b"nothing of the kind")
