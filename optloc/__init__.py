"""optloc: fixes and registrations from passive measurements, without a guess, with a covariance and a verdict."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from optloc.bias import with_bias
from optloc.bounds import Course, crlb, crlb_course
from optloc.build import assemble, measured, station_array
from optloc.epochs import by_epoch
from optloc.errors import InvalidProblem, NoSolution, OptlocError
from optloc.evaluate import predict
from optloc.fix import Alternatives, Fix, Stage
from optloc.frames import CARTESIAN, ECEF, Frame
from optloc.gauss_newton import gauss_newton
from optloc.layout import Layout
from optloc.learnt import with_known_bias
from optloc.linear import Linear, linearise
from optloc.loss import LOSSES, Loss
from optloc.models import MODELS, Model
from optloc.noise import Noise
from optloc.normal import Normal, normal
from optloc.observe import Observability, observability
from optloc.problem import Problem
from optloc.quality.health import Health, health
from optloc.quality.levels import NoiseLevels, noise_levels, with_estimated_noise, with_noise_levels
from optloc.simulate import simulate
from optloc.solve import FORMULATIONS, METHODS, SOLVERS, solve
from optloc.solve.certify import certify
from optloc.solve.prepared import Prepared, prepare
from optloc.solve.reduce import reduce
from optloc.solve.robust import rejected
from optloc.solve.running import Running
from optloc.solve.suspects import suspects
from optloc.status import Certificate, Status
from optloc.suspects import Explanation, Suspect
from optloc.types import Bias, Motion, Prior, Rows, Stations

__version__ = "0.1.0"

__all__ = [
    "CARTESIAN",
    "ECEF",
    "FORMULATIONS",
    "LOSSES",
    "METHODS",
    "MODELS",
    "SOLVERS",
    "Alternatives",
    "Bias",
    "Certificate",
    "Course",
    "Emitters",
    "Explanation",
    "Fix",
    "Frame",
    "Health",
    "InvalidProblem",
    "Layout",
    "Linear",
    "Loss",
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
    "Rows",
    "Running",
    "Stage",
    "Stations",
    "Status",
    "Suspect",
    "assemble",
    "by_epoch",
    "certify",
    "crlb",
    "crlb_course",
    "from_table",
    "gauss_newton",
    "health",
    "linearise",
    "load",
    "measured",
    "noise_levels",
    "normal",
    "observability",
    "predict",
    "prepare",
    "reduce",
    "rejected",
    "separate",
    "simulate",
    "solve",
    "station_array",
    "suspects",
    "with_bias",
    "with_estimated_noise",
    "with_known_bias",
    "with_noise_levels",
]


def __getattr__(name: str) -> Any:
    if name in ("load", "from_table"):
        from optloc import files  # pandas is loaded when a file or a table is read

        return getattr(files, name)
    if name in ("Emitters", "separate"):
        from optloc import several  # scipy.optimize is loaded when emitters are told apart

        return getattr(several, name)
    if name == "datasets":
        return import_module("optloc.datasets")
    raise AttributeError(f"module 'optloc' has no attribute {name!r}")


def _from_table(*args: Any, **options: Any) -> Problem:
    from optloc.files import from_table

    return from_table(*args, **options)


_from_table.__doc__ = "Return the problem of a long table with one row for each measurement; see `optloc.from_table`."
Problem.from_table = staticmethod(_from_table)  # type: ignore[attr-defined]  # files are a higher floor than Problem
