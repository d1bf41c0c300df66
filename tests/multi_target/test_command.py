"""``optloc separate``: the table, JSON, exit codes and one sentence for bad input."""

import json
import re

import numpy as np
import pytest
from multi_target.scenes import RING, STAR, drawn, model
from typer.testing import CliRunner

from optloc.cli import app

RUN = CliRunner()


def written(folder, scene):
    """Return a problem file of a scene."""
    stations = ", ".join(f'{{ name = "S{i}", x = {x}, y = {y} }}' for i, (x, y) in enumerate(RING))
    block = scene.problem.rows[0]
    rows = ",\n".join(
        f'{{ a = "S{a}", b = "S{b}", z = {z} }}' for a, b, z in zip(block.a, block.b, block.z, strict=True)
    )
    text = f'format = 1\n[frame]\nkind = "cartesian"\n[stations]\nrows = [{stations}]\n'
    text += f'[[measurements]]\nkind = "tdoa"\nunit = "m"\nsigma = {scene.sigma}\nrows = [\n{rows}\n]\n'
    path = folder / "site.toml"
    path.write_text(text, encoding="utf-8")
    return path


def run(*arguments, code):
    result = RUN.invoke(app, ["separate", *map(str, arguments)])
    assert result.exit_code == code, result.output + repr(result.exception)
    return result.output


def test_json_names_rows_and_emitters(tmp_path):
    scene = drawn(1, 2)
    found = json.loads(run(written(tmp_path, scene), "--json", code=0))["epochs"][0]
    assert found["status"] == "ok"
    for emitter in found["emitters"]:
        at = np.array(emitter["position"])
        k = np.linalg.norm(scene.emitters - at, axis=-1).argmin()
        spread = np.sqrt(np.diag(emitter["covariance"]))
        assert (np.abs(at - scene.emitters[k]) < 5.0 * spread).all()
        for row in emitter["rows"]:
            assert row.startswith("tdoa S")
    assigned = np.array(found["assignment"])
    assert len(assigned) == scene.problem.count
    residual = (
        scene.problem.z
        - model("tdoa", RING, STAR, np.array(found["emitters"][0]["position"]))[scene.problem.rows[0].a - 1]
    )
    assert (np.abs(residual[assigned == 0]) < 50.0).all()


def test_the_table_says_how_many_and_how_sure(tmp_path):
    path = written(tmp_path, drawn(1, 2))
    output = run(path, code=0)
    assert "2 emitters" in output
    assert re.search(r"│ 1 +│ +-?\d+ ± \d+ │", output)
    assert "no other assignment costs less than" in output
    assert run(path, "--quiet", code=0) == ""


def test_doubt_is_exit_code_1(tmp_path):
    assert "no 9 emitters" in " ".join(run(written(tmp_path, drawn(1, 2)), "--emitters", "9", code=1).split())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--emitters", "two"), "whole number"),
        (("--detection", "1.5"), "detection"),
        (("--false", "0"), "false"),
        (("--region", "1,2"), "LOW:HIGH"),
        (("--region", "1,2:0,0"), "region"),
    ],
)
def test_bad_options_are_one_sentence(options, words, tmp_path):
    result = RUN.invoke(app, ["separate", str(written(tmp_path, drawn(1, 2))), *options])
    assert result.exit_code == 2
    assert words in result.output
    assert len(result.output.splitlines()) == 1
