"""The public names of optloc, and the names that they had before."""

import importlib
import subprocess
import sys
import warnings

import pytest

import optloc

# All public names of version 0.1 before its packages moved.
BEFORE = """
    CARTESIAN ECEF FORMULATIONS LOSSES METHODS MODELS SOLVERS Accuracy Advice Alternatives Arc Atmosphere Bias
    Budget Calibration Certificate Chart CommonLevel Course Emitters Explanation Fix Formulation Frame Health
    InvalidProblem LateSignals Layers Layout Linear Loss Mixture Model Motion Network NoSolution Noise
    NoiseLevels Normal Observability OptlocError Placement Plan Prepared Prior Problem Region Reliability Rows
    Running Samples Signal Stage Stations Status Suspect accuracy advise assemble by_epoch calibrate certify
    clock_densities common_level constraints crlb crlb_course epochs explained frames from_table gauss_newton
    health late_signals likelihood_region linearise load locate measured mixture network_of noise noise_levels
    normal observability place predict prepare reduce rejected reliability samples satellites separate simulate
    solve station_array suspects trace_arc units wander with_bias with_estimated_noise with_known_bias
    with_noise_levels
""".split()
PACKAGES = "adequacy calibration compute live papers placement plot quality report several study".split()


def test_at_most_thirty_names_are_public():
    assert len(optloc.__all__) <= 30
    assert dir(optloc) == sorted(optloc.__all__)


@pytest.mark.parametrize("name", sorted(optloc.__all__))
def test_a_public_name_loads_without_a_warning(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert getattr(optloc, name) is getattr(optloc, name)


@pytest.mark.parametrize("name", [name for name in BEFORE if name not in optloc.__all__])
def test_an_old_name_works_and_warns_with_its_place_of_today(name):
    with pytest.warns(DeprecationWarning, match=rf"optloc\.{name} is (optloc\.\S+) now") as told:
        found = getattr(optloc, name)
    module, _, today = str(told[0].message).split()[2].rpartition(".")
    assert found is getattr(importlib.import_module(module), today)
    assert told[0].filename == __file__


@pytest.mark.parametrize("name", PACKAGES)
def test_an_old_package_imports_and_warns(name):
    code = f"import warnings; warnings.simplefilter('error'); import optloc.{name}"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert f"DeprecationWarning: optloc.{name} is optloc." in answer.stderr


def test_a_module_of_an_old_package_is_the_module_of_today():
    with pytest.warns(DeprecationWarning, match="optloc.multi_target"):
        old = importlib.import_module("optloc.several.sets")
    assert old is importlib.import_module("optloc.multi_target.sets")


def test_the_old_package_of_tracks_names_its_place_of_today():
    with pytest.raises(ModuleNotFoundError, match=r"optloc\.track is a function now; .* optloc\.tracking"):
        importlib.import_module("optloc.track.updates")
    assert callable(optloc.track)


def test_short_paths_of_public_modules_import():
    assert importlib.import_module("optloc.units") is importlib.import_module("optloc.base.units")
    assert importlib.import_module("optloc.constraints") is optloc.constraints


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = optloc.nonsense
