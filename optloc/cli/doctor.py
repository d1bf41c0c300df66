"""The command ``optloc doctor``: versions, machine, caches, missing packages and the commands that install them."""

from __future__ import annotations

import os
import platform
import re
import sys
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

import typer
from rich.table import Table

from optloc.cli.extensions import extensions
from optloc.cli.options import Json, Verbose
from optloc.cli.output import Screen, dumps, say

# Extras for the development of optloc, which users do not need.
_DEVELOPMENT_EXTRAS = frozenset({"test", "lint", "docs"})
_REQUIREMENT = re.compile(r"^([A-Za-z0-9._-]+)[^<>=!~;]*(?:>=([\d.]+))?")
_EXTRA = re.compile(r"""extra\s*==\s*['"]([\w-]+)['"]""")


@dataclass(frozen=True, slots=True)
class Package:
    """A package that optloc uses.

    version: installed version, or None. least: smallest version that works. extra: extra that installs the package,
    empty for packages that each installation has.
    """

    name: str
    version: str | None
    least: str
    extra: str

    @property
    def state(self) -> str:
        """Return "ok", "too old" or "missing"."""
        if self.version is None:
            return "missing"
        return "ok" if _numbers(self.version) >= _numbers(self.least) else "too old"


@dataclass(frozen=True, slots=True)
class MissingPackage:
    """A missing package, its use, and the command that installs it."""

    missing: str
    used_for: str
    command: str


def _numbers(text: str) -> tuple[int, ...]:
    """Return the leading numbers of a version, so that 1.10 sorts above 1.9."""
    found = re.match(r"\d+(?:\.\d+)*", text)
    return tuple(map(int, found[0].split("."))) if found else ()


def packages() -> list[Package]:
    """Return the packages that optloc requires, core packages first; empty if optloc is not installed as a package."""
    found = []
    for line in _or_none(requires, "optloc") or ():
        named, extra = _REQUIREMENT.match(line), _EXTRA.search(line)
        if named is None or (extra is not None and extra[1] in _DEVELOPMENT_EXTRAS):
            continue
        name = named[1]
        found.append(Package(name, _or_none(version, name), named[2] or "", "" if extra is None else extra[1]))
    return sorted(found, key=lambda one: (one.extra, one.name))


def _or_none(of: Any, name: str) -> Any:
    """Return `of(name)` for an installed package, None for a missing package."""
    try:
        return of(name)
    except PackageNotFoundError:
        return None


def machine() -> dict[str, Any]:
    """Return the properties of this computer, the usable processors and the settings of optloc."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    settings = ("OPTLOC_THREADS", "OPTLOC_COMPILE", "OPTLOC_DATA", "NUMBA_CACHE_DIR", "NUMBA_DISABLE_JIT")
    return {
        "system": platform.platform(),
        "processor": platform.machine(),
        "processors": os.cpu_count(),
        "usable": usable,
        "settings": {name: os.environ[name] for name in settings if name in os.environ},
    }


def machine_code() -> dict[str, Any]:
    """Return the folder of the machine code, its processor, and the parts on disk.

    The folder is None if none can be used. Without numba, there are no parts. "parts" has True for a part on disk.
    """
    from optloc.kernels.jit import enabled

    if not enabled():
        return {"folder": None, "made_for": None, "installed": False, "parts": {}}
    from optloc.cli.compile import parts
    from optloc.kernels.code_cache import folder_in_use
    from optloc.kernels.manifest import installed, of_this_process

    place = folder_in_use()
    return {
        "folder": None if place is None else str(place),
        "made_for": of_this_process().processor,
        "installed": installed() is not None,
        "parts": {part.summary: place is not None and not part.missing() for part in parts().values()},
    }


def advice(found: list[Package], code: dict[str, Any]) -> list[MissingPackage]:
    """Return the missing packages with their install commands, packages that all users need first.

    `found` are the packages that optloc uses, and `code` is the state of the machine code.
    """
    missing = [
        MissingPackage(f"{one.name} >= {one.least}", "everything", f"pip install '{one.name}>={one.least}'")
        for one in found
        if not one.extra and one.state != "ok"
    ]
    if not found:
        missing.append(MissingPackage("the installed package", "versions, extras", "pip install ."))
    if not code["parts"]:
        missing.append(MissingPackage("machine code", "speed, about 1000 times", "unset NUMBA_DISABLE_JIT"))
    elif not all(code["parts"].values()):
        lacking = [name for name, there in code["parts"].items() if not there]
        missing.append(MissingPackage("machine code", ", ".join(lacking), "optloc compile"))
    for extra in dict.fromkeys(one.extra for one in found if one.extra and one.state != "ok"):
        names = [one.name for one in found if one.extra == extra and one.state != "ok"]
        missing.append(MissingPackage(", ".join(names), f"the extra {extra}", f"pip install 'optloc[{extra}]'"))
    return missing


def doctor(as_json: Json = False, verbose: Verbose = False) -> None:
    """Print versions, machine, machine code on disk, missing packages and the commands that install them."""
    found, code = packages(), machine_code()
    report = {
        "optloc": {"version": _or_none(version, "optloc"), "folder": str(Path(__file__).resolve().parents[1])},
        "python": {"version": platform.python_version(), "executable": sys.executable},
        "machine": machine(),
        "packages": [asdict(one) | {"state": one.state} for one in found],
        "machine_code": code,
        **{name: fact() for one in extensions() for name, fact in one.facts.items()},
        "advice": [asdict(one) for one in advice(found, code)],
    }
    if as_json:
        typer.echo(dumps(report))
    else:
        _show(report)


def _show(report: dict[str, Any]) -> None:
    """Print the report as lines and a table."""
    screen, here, code = Screen(), report["machine"], report["machine_code"]
    say(screen, f"optloc {report['optloc']['version'] or '(not installed)'} in {report['optloc']['folder']}")
    say(screen, f"Python {report['python']['version']}: {report['python']['executable']}")
    say(screen, f"{here['system']}; {here['usable']} of {here['processors']} processors are usable")
    for name, value in here["settings"].items():
        say(screen, f"{name}={value}")
    table = Table("package", "version", "needed", "for", "state")
    for one in report["packages"]:
        needed = f">= {one['least']}" if one["least"] else "any"
        table.add_row(one["name"], one["version"] or "-", needed, one["extra"] or "all", one["state"])
    screen.print(table)
    if code["parts"]:
        say(screen, f"Machine code for {code['made_for']} is stored in {code['folder'] or 'no folder'}")
        for name, there in code["parts"].items():
            say(screen, f"  {'yes' if there else 'no ':3} {name}")
    if report.get("datasets", {}).get("folder"):
        say(screen, f"Data sets in {report['datasets']['folder']}: {', '.join(report['datasets']['there']) or 'none'}")
    say(screen, "Nothing is missing." if not report["advice"] else "Missing:")
    for one in report["advice"]:
        say(screen, f"  {one['missing']} ({one['used_for']}): {one['command']}")
