"""Study files: what is wrong is said in one sentence with the nearest name; shipped studies run."""

from pathlib import Path

import numpy as np
import pytest
from lab.study.texts import QUICK, design
from progress import without_progress
from typer.testing import CliRunner

import optloc
from optloc.base.errors import InvalidProblem
from optloc.cli import app
from optloc.lab.study.design import design_of, shipped
from optloc.lab.study.methods import SETTINGS, backends, check_settings
from optloc.lab.study.trial import compute
from optloc.solvers.methods import Choice, counting, using

RUN = CliRunner()
# networks: its methods are those of tests/lab/study/test_networks.py, of which some take seconds
STUDIES = [pytest.param(name, marks=pytest.mark.full) if name == "networks" else name for name in sorted(shipped())]
BAD = {
    "method": ('"gtrs+lsr"', '"gtsr+lsr"', "unknown method 'gtsr'; did you mean 'gtrs'"),
    "baseline": ('method = "gtrs+lsr"', 'baseline = "tailor"', "unknown baseline 'tailor'; did you mean 'taylor'"),
    "no method": ('"gtrs+lsr"', "[]", "its list of methods is empty"),
    "two methods": ('"gtrs+lsr"', '"gtrs+lsr"\nbaseline = "taylor"', "give either method or baseline"),
    "solver": ('"gtrs+lsr"', '"sdp"\nsolver = "SCZ"', "unknown solver 'SCZ'; did you mean 'SCS'"),
    "licence": ('"gtrs+lsr"', '"gtrs+nlp"\nsolver = "snopt"', "the solver 'snopt' is not installed"),
    "settings": ('"gtrs+lsr"', '"gtrs+lsr"\nsettings = { eps = 1 }', "settings need a solver"),
    **{
        f"hostile {i}": ('"gtrs+lsr"', f'"{method}"\nsolver = "{solver}"\nsettings = {{ {hostile} }}', words)
        for i, (method, solver, hostile, words) in enumerate(
            [
                ("gtrs+nlp", "sqpmethod", 'jit = true, compiler = "shell"', "a study may not set 'jit' of sqpmethod"),
                (
                    "gtrs+nlp",
                    "sqpmethod",
                    'jit_options = { compiler = "true; cc" }',
                    "a study may not set 'jit_options'",
                ),
                ("gtrs+nlp", "ipopt", 'output_file = "stray.txt"', "a study may not set 'output_file' of ipopt"),
                ("gtrs+nlp", "ipopt", 'option_file_name = "stray.opt"', "a study may not set 'option_file_name'"),
                ("gtrs+nlp", "ipopt", 'linear_solver = "ma27"', "a study may not set 'linear_solver' of ipopt"),
                ("sdp", "SCS", 'write_data_filename = "stray"', "a study may not set 'write_data_filename' of SCS"),
                ("sdp", "SCS", 'log_csv_filename = "stray.csv"', "a study may set acceleration_interval"),
                ("sdp", "CLARABEL", 'direct_solve_method = "pardiso"', "a study may not set 'direct_solve_method'"),
                ("sdp", "SCS", "max_iters = -1", "max_iters is -1"),
                ("sdp", "SCS", "max_iters = 2.5", "give a whole number from 1 to 1e+09"),
                ("sdp", "SCS", 'eps_abs = "1e-3"', "eps_abs is '1e-3'"),
                ("sdp", "SCS", "eps_abs = nan", "eps_abs is nan"),
                ("sdp", "SCS", "normalize = 1", "give true or false"),
                ("sdp", "SCS", "eps_abs = true", "eps_abs is True"),
                ("gtrs+nlp", "fatrop", "max_iter = 3", "no settings of this solver"),
            ]
        )
    },
    "kind": ('["toa"]', '["taoa"]', "unknown kind 'taoa'; did you mean 'toa'"),
    "geometry": ("layout = { stations = 6 }", "", "a scenario has one geometry"),
    "problem": ("layout = { stations = 6 }", 'problem = "dema"', "unknown problem 'dema'; did you mean 'demo'"),
    "file": ("layout = { stations = 6 }", 'problem = "nowhere.toml"', "no such file"),
    "unit": ('"3 m"', '"3 mm/s"', "unknown unit 'mm/s'"),
    "no unit": ('["3 m"]', "[3.0]", "has no unit"),
    "negative": ('"3 m"', '"-3 m"', "not positive"),
    "truth": ('"hull"', '"hole"', "did you mean 'hull'"),
    "truth keys": ('{ kind = "hull" }', '{ kind = "hull", at = [1.0] }', "has no key 'at'"),
    "distance": (', distance = ["5 km", "20 km"]', "", "needs the key 'distance'"),
    "velocity": ('{ kind = "hull" }', '{ kind = "hull", speed = "3 m/s" }', "does not move"),
    "key": ("seed = 5", "sede = 5", "unknown key 'sede'; did you mean 'seed'"),
    "sweep": ('noise = ["3 m"]', 'noise = ["3 m"]\nsweep = { "layout.station" = [5] }', "did you mean 'stations'"),
    "twice": ('"arrivals"', '"differences"', "two scenarios 'differences'"),
    "kinds of levels": ('["3 m"]', '[{ tdoa = "3 m" }]', "levels do not fit"),
    "bias": ('noise = ["3 m"]', 'noise = ["3 m"]\nbias = { clock = 3.0 }', "unknown bias 'clock'"),
    "format": ("format = 1", "format = 2", "format 2 is unknown"),
    "empty sweep": ('noise = ["3 m"]', 'noise = ["3 m"]\nsweep = { "layout.stations" = [] }', "has no values"),
}


def sentence(result):
    assert result.exit_code == 2, result.output + repr(result.exception)
    assert len(without_progress(result.stderr)) == 1
    assert "Traceback" not in result.output
    return result.stderr


@pytest.mark.parametrize("name", BAD)
def test_bad_studies_are_one_sentence(name, tmp_path):
    old, new, words = BAD[name]
    assert old in QUICK
    (tmp_path / "s.toml").write_text(QUICK.replace(old, new))
    result = RUN.invoke(app, ["study", "run", str(tmp_path / "s.toml"), "--out", str(tmp_path / "out")])
    assert words in sentence(result)
    assert not (tmp_path / "out").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["s.toml"]


@pytest.mark.parametrize("solver", [name for name, own in SETTINGS.items() if own and name in backends()])
def test_every_setting_of_the_table_is_one_that_its_back_end_knows(solver):
    """A library refuses a name that it does not know."""
    backend = backends()[solver]
    middle = {bool: True, int: 50, float: 1e-4}
    given = {name: max(middle[one.kind], one.least) for name, one in SETTINGS[solver].items()}
    given |= {name: 10.0 for name in given if "time" in name}
    given.pop("eps", None)  # stands for eps_abs and eps_rel, and not beside them
    check_settings(solver, given, "settings")
    stations = np.random.default_rng(3).uniform(-5e3, 5e3, (6, 3))
    template = optloc.assemble(stations, optloc.measured("range", a=np.arange(6), sigma=10.0))
    problem = optloc.simulate(template, [1e3, 500.0, 200.0], 1)
    with using(Choice(backend.kind, solver, given)), counting() as tally:
        optloc.solve(problem, "socp" if backend.kind == "conic" else "gtrs+nlp")
    assert solver in {name for name, _ in tally}


def test_lists_show_what_studies_are_made_of():
    for what, words in {
        "solvers": ("CLARABEL", "ipopt", "sqpmethod", "scipy", "lsr", "version"),
        "baselines": ("taylor", "lifted-sdp"),
        "executors": ("dask", "processes"),
        "studies": tuple(shipped()),
        "methods": ("auto",),
    }.items():
        shown = RUN.invoke(app, ["list", what, "--json"]).stdout
        assert all(word in shown for word in words), what


@pytest.mark.parametrize("name", STUDIES)
def test_shipped_studies_run(name):
    made = design_of(Path(name), trials=1)
    methods = {}
    for one in made.chunks:
        methods.setdefault(one.cell.method.name, []).append(one)
    assert len(methods) == len({cell.method.name for cell in made.cells})
    for i, chunks in enumerate(methods.values(), 1):  # each method once, on the scenarios in turn
        assert compute(chunks[i % len(chunks)]).counts.get("died", 0) == 0


def test_options_take_the_place_of_what_the_file_says():
    assert design(QUICK, trials=7).rows == 21
    assert design(QUICK, seed=9).fingerprint != design(QUICK).fingerprint
    with pytest.raises(InvalidProblem):
        design(QUICK.replace("trials = 60", "trials = 0"))
