"""Airliners' messages as a stream, ten times as fast as they came: the numbers of `optloc fix`."""

import json
from decimal import Decimal

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from optloc.cli import app
from optloc.lab.datasets import adsb

pytestmark = pytest.mark.data

MESSAGES = 40


def written(folder, source):
    """Write the first messages as a problem file and as a recording; return how many."""
    stations, rows, truth = (
        pd.read_csv(source / f"{name}.csv", dtype=str) for name in ("stations", "measurements", "truth")
    )
    truth = truth[truth["set"] == "1"].head(MESSAGES).sort_values("t_server_s", key=lambda v: v.astype(float))
    places = [
        f'{{ name = "{r.station}", x = {r.x_m}, y = {r.y_m}, z = {r.z_m} }}' for r in stations.itertuples(index=False)
    ]
    toa, heights, lines = [], [], []
    for message in truth.itertuples(index=False):
        own = rows[(rows["set"] == message.set) & (rows["msg"] == message.msg)]
        first = min(map(Decimal, own["toa_s"]))
        toa += [
            f'{{ epoch = "{message.msg}", a = "{r.station}", z = {float(Decimal(r.toa_s) - first)!r} }}'
            for r in own.itertuples(index=False)
        ]
        heights.append(f'{{ epoch = "{message.msg}", z = {message.h_geo_m} }}')
        line = {
            "received": float(message.t_server_s),
            "event": message.msg,
            "target": message.aircraft,
            "arrivals": [{"station": r.station, "time": r.toa_s} for r in own.itertuples(index=False)],
            "rows": [{"kind": "height", "z": float(message.h_geo_m)}],
        }
        lines.append(json.dumps(line))
    (folder / "adsb.toml").write_text(f"""
format = 1
frame = {{ kind = "ecef" }}
[stations]
rows = [{", ".join(places)}]
[[measurements]]
kind = "toa"
unit = "s"
sigma = "{adsb.ARRIVAL} m"
rows = [{", ".join(toa)}]
[[measurements]]
kind = "height"
sigma = {adsb.HEIGHT}
rows = [{", ".join(heights)}]
""")
    (folder / "adsb.ndjson").write_text("\n".join(lines))
    return [float(value) for value in truth["t_server_s"]]


def test_a_replay_gives_the_numbers_of_fix(data_dir, tmp_path):
    times = written(tmp_path, data_dir / "locards_adsb")
    run = CliRunner().invoke
    fixed = run(app, ["fix", str(tmp_path / "adsb.toml"), "--out", str(tmp_path / "fixes.csv"), "-q"])
    assert fixed.exit_code in (0, 1), fixed.output
    fixes = pd.read_csv(tmp_path / "fixes.csv", dtype={"epoch": str}).set_index("epoch")
    speed = max(10.0, (times[-1] - times[0]) / 1.5)
    words = ["live", str(tmp_path / "adsb.toml"), "--replay", str(tmp_path / "adsb.ndjson"), "--phases", "one", "-q"]
    streamed = run(app, [*words, "--speed", str(speed)])
    assert streamed.exit_code == 0, streamed.output
    records = [json.loads(each) for each in streamed.stdout.splitlines()]
    assert len(records) == len(fixes) == MESSAGES
    same = 0
    for record in records:
        fix = fixes.loc[record["event"]]
        assert record["dof"] == fix["dof"]
        # a file of all stations gives the proof of each message fewer boxes than its five stations would have
        same += (record["status"], record["proof"]) == (fix["status"], fix["proof"])
        assert record["status"] == fix["status"] or fix["status"] == "unproven"
        assert record["position"] == pytest.approx(fix[["x", "y", "z"]].to_numpy(float), abs=1e-4)
        assert record["cost"] == pytest.approx(fix["cost"], rel=1e-6, abs=1e-9)
        assert np.sqrt(np.diagonal(record["cov"])) == pytest.approx(
            fix[["sigma_x", "sigma_y", "sigma_z"]].to_numpy(float), rel=1e-6
        )
    assert same >= 0.9 * MESSAGES
