"""What is distributed: built from the source archive alone, installed without extras, and run as a newcomer would."""

import os
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.packaging
ROOT = Path(__file__).resolve().parents[1]
# Newcomers have not asked anybody to wait for machine code.
NEWCOMERS = {name: value for name, value in os.environ.items() if name != "OPTLOC_COMPILE"}
# Modules that import an extra when they are imported.
OF_EXTRAS = ("optloc.plugins.stonesoup", "optloc.show.pictures.notebook_figure")
NOT_SHIPPED = (".ci/", ".gitignore", ".pre-commit-config.yaml")


def called(*command, cwd=None, code=0, **more):
    found = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, cwd=cwd, env=NEWCOMERS | more, check=False
    )
    assert found.returncode == code, found.stdout + found.stderr
    return found.stdout


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    """Build the source archive, and the wheel from it."""
    folder = tmp_path_factory.mktemp("dist")
    called(sys.executable, "-m", "build", "--outdir", folder, ROOT)
    return folder


@pytest.fixture(scope="session")
def bare(built, tmp_path_factory):
    """Install the wheel into a new environment that has the core dependencies and nothing else."""
    folder = tmp_path_factory.mktemp("bare")
    venv.create(folder, with_pip=True)
    (wheel,) = built.glob("*.whl")
    called(folder / "bin" / "pip", "install", "--quiet", "--no-compile", wheel)
    return folder / "bin"


def test_the_wheel_holds_the_packages_with_their_types_and_files(built):
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    wanted = {
        path.relative_to(ROOT).as_posix()
        for package in ("optloc", "formulations")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.suffix not in (".nbi", ".nbc")
    }
    assert {"optloc/py.typed", "formulations/py.typed"} <= wanted
    assert not wanted - names
    foreign = {name.split("/")[0] for name in names} - {"optloc", "formulations"}
    assert all(name.endswith(".dist-info") for name in foreign)


def test_the_source_archive_holds_what_tests_and_pages_need(built):
    (archive,) = built.glob("*.tar.gz")
    with tarfile.open(archive) as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    if (ROOT / ".git").exists():
        listed = called("git", "ls-files", cwd=ROOT).split("\n")
    else:
        listed = [path.relative_to(ROOT).as_posix() for path in (ROOT / "tests").rglob("*.py")]
    there = {name for name in listed if name and (ROOT / name).exists() and not name.startswith(NOT_SHIPPED)}
    assert {"README.md", "LICENSE", "tests/conftest.py"} <= names
    assert not there - names


def test_a_newcomer_sees_a_fix_without_any_extra(bare, tmp_path):
    packages = called(bare / "pip", "list", "--format=freeze").lower()
    assert not [name for name in ("matplotlib", "pytest", "dask", "cvxopt") if f"\n{name}" in packages]
    text = called(bare / "optloc", "demo", cwd=tmp_path)
    assert "ok" in text
    assert "optloc[plot]" in text  # where the picture would be


def test_the_commands_fix_and_name_the_extra_that_they_need(bare, tmp_path):
    where = "import optloc; print(optloc.__path__[0])"
    package = Path(called(bare / "python", "-c", where, cwd=tmp_path).strip())
    assert ROOT not in package.parents
    file = package / "scenarios" / "demo.toml"
    assert '"ok"' in called(bare / "optloc", "fix", file, "--json", cwd=tmp_path)
    found = subprocess.run(
        [bare / "optloc", "fix", file, "--plot", "p.png"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=NEWCOMERS,
        check=False,
    )
    assert found.returncode == 2
    assert "optloc[plot]" in found.stderr
    assert "Traceback" not in found.stderr
    called(bare / "optloc", "list", "kinds", cwd=tmp_path)


def test_every_module_but_those_of_extras_is_imported(bare, tmp_path):
    code = f"""
import importlib, pkgutil, formulations, optloc
OF_EXTRAS = {OF_EXTRAS}
for package in (formulations, optloc):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not module.name.startswith(OF_EXTRAS) and not module.name.endswith("__main__"):
            importlib.import_module(module.name)
"""
    called(bare / "python", "-W", "error::DeprecationWarning:optloc", "-c", code, cwd=tmp_path)
