"""Position fixes and sensor registration from passive measurements: no first guess, a covariance and a status."""

from __future__ import annotations

import os
import signal
import sys

# The libraries of the command line take half a second to load. Ctrl-C in this time ends the program without a
# traceback.
_NAME = os.path.basename("".join(sys.argv[:1]))  # noqa: PTH119  (pathlib takes its time, too)
_MODULES, _SCRIPTS = {"optloc", "optloc.cli"}, {"optloc", "optloc.exe", "optloc-script.py"}
_RUNS = _NAME in _SCRIPTS or (_NAME == "-m" and not _MODULES.isdisjoint(sys.orig_argv))
if _RUNS and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from optloc.base.faces import exported
from optloc.base.moved import MOVED, moved, watch_old_packages
from optloc.base.plots import set_plots
from optloc.base.short_form import set_short_forms
from optloc.problem.fix import set_renderer
from optloc.problem.problem import Problem

# All other names load at their first use: solvers, proofs and tables take half a second together.
if TYPE_CHECKING:
    import optloc.bounds
    import optloc.engine
    import optloc.files
    import optloc.lab
    import optloc.model_checks
    import optloc.models
    import optloc.multi_target
    import optloc.partitions
    import optloc.problem
    import optloc.service
    import optloc.show
    import optloc.sites
    import optloc.solvers
    import optloc.station_health
    import optloc.tracking
    import optloc.uncertainty
    from optloc.advice.diagnosis import diagnose as diagnose
    from optloc.base import units as units
    from optloc.base.errors import InvalidProblem as InvalidProblem, NoSolution as NoSolution
    from optloc.base.frames import Frame as Frame
    from optloc.base.types import Motion as Motion, Stations as Stations, Status as Status
    from optloc.bounds.cramer_rao import crlb as crlb
    from optloc.files.long_table import from_table as from_table
    from optloc.files.one_call import locate as locate
    from optloc.files.reader import load as load
    from optloc.lab import datasets as datasets
    from optloc.linear import constraints as constraints
    from optloc.linear.simulate import simulate as simulate
    from optloc.multi_target.assign import separate as separate
    from optloc.partitions.one_partition import fix_table as fix_table
    from optloc.problem.bias import with_bias as with_bias
    from optloc.problem.build import assemble as assemble, measured as measured, station_array as station_array
    from optloc.problem.fix import Fix as Fix
    from optloc.problem.problem import Problem as Problem
    from optloc.sites.calibration.calibrated import calibrate as calibrate
    from optloc.sites.placement.chosen import place as place
    from optloc.solvers.certificates.admitted import certify as certify
    from optloc.solvers.posing.choose_formulation import pose as pose
    from optloc.solvers.prepared import prepare as prepare
    from optloc.solvers.solution import solve as solve
    from optloc.tracking.run import track as track

__version__ = "0.1.0"

if not TYPE_CHECKING:
    _find, __dir__, __all__ = exported(__name__, __file__)

    def __getattr__(name: str) -> Any:
        if name in __all__:
            return _find(name)
        if name in MOVED:
            return moved(name)
        if not name.startswith("_") and find_spec(f"optloc.{name}") is not None:
            return import_module(f"optloc.{name}")  # a folder, such as `optloc.tracking`
        raise AttributeError(f"module 'optloc' has no attribute {name!r}")


watch_old_packages()
set_renderer(lambda: import_module("optloc.show.fixes"))
# Neighbours describe their own values; the folder `show` describes the values of the core.
_FORMS = {"sites": "optloc.sites.site_forms", "lab": "optloc.lab.lab_forms"}
set_short_forms(lambda folder: import_module(_FORMS.get(folder, "optloc.show.short_forms")))
# Neighbours draw their own values; the folder `show` draws the values of the core.
set_plots(lambda folder: import_module("optloc.sites.site_plots" if folder == "sites" else "optloc.show.core_plots"))


def _from_table(*args: Any, **options: Any) -> Problem:
    from optloc.files import from_table

    return from_table(*args, **options)


_from_table.__doc__ = "Return the problem of a long table with one row for each measurement; see `optloc.from_table`."
Problem.from_table = staticmethod(_from_table)  # type: ignore[attr-defined]  # files are a higher floor than Problem
