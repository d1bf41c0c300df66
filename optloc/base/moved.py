"""Old names of version 0.1 that have moved. They work with a deprecation warning until version 0.2."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

# Names that were attributes of `optloc`, by the package that exports them now.
_NAMES = {
    "optloc.advice": "Advice advise",
    "optloc.bounds": "Course Observability crlb_course observability",
    "optloc.engine": "Linear Normal gauss_newton linearise normal predict reduce",
    "optloc.files": "Budget satellites",
    "optloc.model_checks": ("CommonLevel LateSignals Reliability determined distance_from_plane explained reliability"),
    "optloc.models": "Atmosphere Layers MODELS Model",
    "optloc.multi_target": "Emitters",
    "optloc.problem": (
        "Alternatives Bias CARTESIAN Certificate Chart Determined Direction ECEF Explanation LOSSES "
        "Layout Loss Noise OptlocError Prior Quantity Rows Signal Stage Suspect by_epoch clock_densities "
        "with_known_bias"
    ),
    "optloc.sites.calibration": "Calibration Network network_of",
    "optloc.sites.placement": "Placement SiteSelection",
    "optloc.solvers": (
        "FORMULATIONS Formulation METHODS Prepared Running SOLVERS StatusShares rejected status_shares suspects"
    ),
    "optloc.station_health": (
        "Health NoiseLevels NoiseStructure common_level health late_signals noise_levels noise_structure "
        "with_estimated_noise with_noise_levels"
    ),
    "optloc.uncertainty": "Accuracy Arc Mixture Region Samples accuracy likelihood_region mixture samples trace_arc",
}
# Modules that were attributes of `optloc`.
_MODULES = {"epochs": "optloc.problem.epochs", "frames": "optloc.base.frames", "noise": "optloc.problem.noise"}
_RENAMED = {"Plan": "optloc.sites.placement.SiteSelection", "wander": "optloc.engine.simulate_walks"}
_PLACES = (
    {name: f"{package}.{name}" for package, names in _NAMES.items() for name in names.split()} | _MODULES | _RENAMED
)

MOVED = frozenset(_PLACES)
"""All old names."""

# Old names of packages, and their new places inside `optloc`.
_PACKAGES = {
    "adequacy": "model_checks",
    "calibration": "sites.calibration",
    "compute": "kernels",
    "live": "service",
    "papers": "lab.papers",
    "placement": "sites.placement",
    "plot": "show.pictures",
    "quality": "station_health",
    "report": "show",
    "several": "multi_target",
    "study": "lab.study",
}

# Modules with a shorter public path. They can be imported by it without a warning.
_SHORT = {"constraints": "linear.constraints", "datasets": "lab.datasets", "units": "base.units"}


def moved(name: str) -> Any:
    """Return the object of an old name of `optloc`, with a deprecation warning."""
    place = _PLACES[name]
    _warn(f"optloc.{name}", place, 4)
    package, _, inner = place.rpartition(".")
    return import_module(place) if name in _MODULES else getattr(import_module(package), inner)


def renamed(old: str, given: Any, new: str, value: Any) -> Any:
    """Return the value of a renamed argument, with a deprecation warning if the old name is used.

    `given` is the value under the old name and `value` under the new name; None means that it is not given.
    """
    if given is None:
        return value
    if value is not None:
        raise TypeError(f"{old} is the old name of {new}: give one of them")
    text = f"the argument {old} is {new} now; version 0.2 removes the old name"
    warnings.warn(text, DeprecationWarning, stacklevel=3)
    return given


def _warn(old: str, new: str, level: int) -> None:
    """Warn that a name is old; `level` is the number of calls between this function and the code of the user."""
    warnings.warn(f"{old} is {new} now; version 0.2 removes the old name", DeprecationWarning, stacklevel=level)


class _Alias(Loader):
    """Loader that replaces a module with an old name by the module with the new name."""

    def __init__(self, place: str) -> None:
        """Store the new name of the module."""
        self._place = place

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Return None, so that Python makes an empty module."""
        return None

    def exec_module(self, module: ModuleType) -> None:
        """Replace the empty module by the present module."""
        sys.modules[module.__name__] = import_module(self._place)


class _OldPackages(MetaPathFinder):
    """Finder of packages and their modules by old names."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return a spec that loads the module with the new name; None for all other names."""
        root, _, rest = fullname.partition(".")
        old, _, inner = rest.partition(".")
        if root == "optloc" and old == "track":
            raise ModuleNotFoundError(
                "optloc.track is a function now; its modules are in optloc.tracking", name=fullname
            )
        if root != "optloc" or old not in _PACKAGES | _SHORT:
            return None
        place = ".".join(filter(None, ("optloc", (_PACKAGES | _SHORT)[old], inner)))
        if old in _PACKAGES:
            _warn(fullname, place, 3)
        return ModuleSpec(fullname, _Alias(place), is_package=True)


def watch_old_packages() -> None:
    """Register the finder of packages with old names."""
    if not any(isinstance(finder, _OldPackages) for finder in sys.meta_path):
        sys.meta_path.insert(0, _OldPackages())  # first, so that no module is loaded twice under two names
