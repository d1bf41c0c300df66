"""optloc: fixes and registrations from passive measurements, without a guess, with a covariance and a verdict."""

from __future__ import annotations

import os
import signal
import sys

# The libraries of the command line take half a second to load: Ctrl-C ends it then as it does later, quietly.
_NAME = os.path.basename("".join(sys.argv[:1]))  # noqa: PTH119  (pathlib takes its time, too)
_RUNS = _NAME in {"optloc", "optloc.exe", "optloc-script.py"} or (_NAME == "-m" and "optloc.cli" in sys.orig_argv)
if _RUNS and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))

from importlib import import_module
from typing import Any

from optloc.adequacy.evidence import Reliability, reliability
from optloc.adequacy.level import CommonLevel, LateSignals
from optloc.base import frames, units
from optloc.base.errors import InvalidProblem, NoSolution, OptlocError
from optloc.base.frames import CARTESIAN, ECEF, Frame
from optloc.base.inputs import Budget
from optloc.base.types import Bias, Certificate, Motion, Prior, Rows, Stations, Status
from optloc.bounds.crlb import Course, crlb, crlb_course
from optloc.bounds.observability import Observability, observability
from optloc.linear import constraints
from optloc.linear.evaluate import predict
from optloc.linear.gauss_newton import gauss_newton
from optloc.linear.normal import Linear, Normal, linearise, normal
from optloc.linear.simulate import simulate
from optloc.linear.walks import wander
from optloc.models import MODELS, Model
from optloc.problem import epochs, noise
from optloc.problem.bias import with_bias, with_known_bias
from optloc.problem.build import assemble, measured, station_array
from optloc.problem.chart import Chart
from optloc.problem.clocks import clock_densities
from optloc.problem.epochs import by_epoch
from optloc.problem.fix import Alternatives, Explanation, Fix, Stage, Suspect, told_by
from optloc.problem.layout import Layout
from optloc.problem.loss import LOSSES, Loss
from optloc.problem.noise import Noise
from optloc.problem.problem import Problem
from optloc.problem.signal import Signal
from optloc.quality.health import Health, health
from optloc.quality.levels import (
    NoiseLevels,
    common_level,
    late_signals,
    noise_levels,
    with_estimated_noise,
    with_noise_levels,
)
from optloc.solvers import FORMULATIONS, METHODS, SOLVERS, Formulation, solve
from optloc.solvers.certify.branch_and_bound import certify
from optloc.solvers.prepared import Prepared, prepare
from optloc.solvers.robust.stage import rejected
from optloc.solvers.running import Running
from optloc.solvers.starts.least_squares_ranges import reduce
from optloc.solvers.suspects.stage import suspects

__version__ = "0.1.0"

__all__ = [
    "CARTESIAN",
    "ECEF",
    "FORMULATIONS",
    "LOSSES",
    "METHODS",
    "MODELS",
    "SOLVERS",
    "Accuracy",
    "Advice",
    "Alternatives",
    "Arc",
    "Bias",
    "Budget",
    "Certificate",
    "Chart",
    "CommonLevel",
    "Course",
    "Emitters",
    "Explanation",
    "Fix",
    "Formulation",
    "Frame",
    "Health",
    "InvalidProblem",
    "LateSignals",
    "Layout",
    "Linear",
    "Loss",
    "Mixture",
    "Model",
    "Motion",
    "NoSolution",
    "Noise",
    "NoiseLevels",
    "Normal",
    "Observability",
    "OptlocError",
    "Prepared",
    "Prior",
    "Problem",
    "Region",
    "Reliability",
    "Rows",
    "Running",
    "Samples",
    "Signal",
    "Stage",
    "Stations",
    "Status",
    "Suspect",
    "accuracy",
    "advise",
    "assemble",
    "by_epoch",
    "certify",
    "clock_densities",
    "common_level",
    "constraints",
    "crlb",
    "crlb_course",
    "epochs",
    "explained",
    "frames",
    "from_table",
    "gauss_newton",
    "health",
    "late_signals",
    "likelihood_region",
    "linearise",
    "load",
    "locate",
    "measured",
    "mixture",
    "noise",
    "noise_levels",
    "normal",
    "observability",
    "predict",
    "prepare",
    "reduce",
    "rejected",
    "reliability",
    "samples",
    "satellites",
    "separate",
    "simulate",
    "solve",
    "station_array",
    "suspects",
    "trace_arc",
    "units",
    "wander",
    "with_bias",
    "with_estimated_noise",
    "with_known_bias",
    "with_noise_levels",
]


_UNCERTAINTY = {
    "Accuracy": "radii",
    "Arc": "arc",
    "Mixture": "posterior",
    "Region": "region",
    "Samples": "posterior",
    "accuracy": "radii",
    "likelihood_region": "region",
    "mixture": "posterior",
    "samples": "posterior",
    "trace_arc": "arc",
}


def __getattr__(name: str) -> Any:
    if name in _UNCERTAINTY:
        return getattr(import_module(f"optloc.uncertainty.{_UNCERTAINTY[name]}"), name)
    if name in ("load", "from_table"):
        from optloc import files  # pandas is loaded when a file or a table is read

        return getattr(files, name)
    if name == "locate":
        from optloc.files.locate import locate  # tables are read by the same libraries

        return locate
    if name == "satellites":
        from optloc.files.orbits import satellites  # orbits are of an extra

        return satellites
    if name in ("Emitters", "separate"):
        from optloc import several  # scipy.optimize is loaded when emitters are told apart

        return getattr(several, name)
    if name in ("Advice", "advise", "explained"):
        from optloc.adequacy import advice  # only who has something to mend needs it

        return getattr(advice, name)
    if name == "datasets":
        return import_module("optloc.datasets")
    raise AttributeError(f"module 'optloc' has no attribute {name!r}")


told_by(lambda: import_module("optloc.report.fixes"))


def _from_table(*args: Any, **options: Any) -> Problem:
    from optloc.files import from_table

    return from_table(*args, **options)


_from_table.__doc__ = "Return the problem of a long table with one row for each measurement; see `optloc.from_table`."
Problem.from_table = staticmethod(_from_table)  # type: ignore[attr-defined]  # files are a higher floor than Problem
