"""RINEX 3 and its rewriting in version 2 hold the same pseudoranges and ephemerides."""

from pathlib import Path

import numpy as np
import pytest

from optloc.base.errors import InvalidProblem
from optloc.files.rinex import is_rinex, read_navigation, read_observations

HERE = Path(__file__).parent
OBSERVED, BROADCAST = HERE / "kamakura.rnx", HERE / "kamakura.nav"
NOON = 1300190400.0


def in_version_2(folder):
    """Return the real files of GPS in RINEX 2, whose lines are shorter and whose years have two digits."""
    seen, lines = read_observations(OBSERVED, "G"), []
    lines += [f"{'     2.11           OBSERVATION DATA    G (GPS)':<60}RINEX VERSION / TYPE"]
    lines += [f"{'     6    L1    C1    S1    P2    L2    S2':<60}# / TYPES OF OBSERV"]
    lines += [f"{'  2021     3    19    12     0    0.0000000     GPS':<60}TIME OF FIRST OBS", f"{'':60}END OF HEADER"]
    for time in np.unique(seen.time):
        rows = np.flatnonzero(seen.time == time)
        minute, names = int(time - NOON) // 60, "".join(seen.satellite[rows])
        lines += [f" 21  3 19 12 {minute:2d}  0.0000000  0 {len(rows):2d}{names[:36]}"]
        lines += [f"{'':32}{names[k : k + 36]}" for k in range(36, len(names), 36)]
        for row in rows:  # five on the first line: the second of them is C1
            lines += [f"{1.0:14.3f}  {seen.pseudorange[row]:14.3f} 7{1.0:14.3f}  {'':16}{2.0:14.3f}", f"{3.0:14.3f}"]
    (folder / "site0781.21o").write_text("\n".join(lines) + "\n")
    text = BROADCAST.read_text().splitlines()
    end = next(i for i, line in enumerate(text) if "END OF HEADER" in line)
    parts = {line[:4]: line for line in text[:end] if "IONOSPHERIC" in line}
    lines = [f"{'     2.11           N: GPS NAV DATA':<60}RINEX VERSION / TYPE"]
    for key, label in (("GPSA", "ION ALPHA"), ("GPSB", "ION BETA")):
        lines += [f"{'  ' + parts[key][5:53]:<60}{label}"]
    lines += [f"{'':60}END OF HEADER"]
    for i in range(end + 1, len(text), 8):
        if text[i][0] == "G":
            number, numbers = text[i][1:3], text[i][23:80]
            year, *rest = text[i][4:23].split()
            stamp = f"{int(year) % 100:02d} " + " ".join(f"{int(v):2d}" for v in rest[:4]) + f"{float(rest[4]):5.1f}"
            lines += [f"{int(number):2d} {stamp}{numbers}", *(line[1:] for line in text[i + 1 : i + 8])]
    (folder / "site0781.21n").write_text("\n".join(lines) + "\n")
    return folder / "site0781.21o", folder / "site0781.21n"


def test_version_2_says_the_same(tmp_path):
    observed, broadcast = in_version_2(tmp_path)
    old, new = read_observations(observed, "G"), read_observations(OBSERVED, "G")
    assert old.satellite.tolist() == new.satellite.tolist()
    assert np.array_equal(old.time, new.time)
    assert np.allclose(old.pseudorange, new.pseudorange, atol=1e-6)
    before, now = read_navigation(broadcast), read_navigation(BROADCAST)
    assert np.array_equal(before.ionosphere, now.ionosphere)
    for name, one in before.ephemerides.items():
        assert np.array_equal(np.array(one), np.array(now.ephemerides[name])), name


def test_the_reader_names_what_a_file_lacks():
    with pytest.raises(InvalidProblem, match="has no ephemerides"):
        read_navigation(OBSERVED)
    known = read_navigation(BROADCAST)
    assert known.ionosphere.tolist()[0] == pytest.approx(1.118e-8)
    assert len(known.ephemerides) > 20


def test_a_file_is_known_by_its_first_line(tmp_path):
    other = tmp_path / "table.csv"
    other.write_text("name,x,y\nA,0,0\n")
    assert is_rinex(OBSERVED)
    assert is_rinex(BROADCAST)
    assert not is_rinex(other)
