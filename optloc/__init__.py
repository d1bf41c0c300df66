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
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from optloc.problem.fix import told_by
from optloc.problem.problem import Problem

# Everything else loads when its name is first used: solvers, proofs and tables take half a second together.
if TYPE_CHECKING:
    from optloc.base import frames, units
    from optloc.base.errors import InvalidProblem, NoSolution, OptlocError
    from optloc.base.frames import CARTESIAN, ECEF, Frame
    from optloc.base.inputs import Budget
    from optloc.base.types import Bias, Certificate, Motion, Prior, Rows, Stations, Status
    from optloc.bounds.cramer_rao import Course, crlb, crlb_course
    from optloc.bounds.rank import Observability, observability
    from optloc.files import from_table, load
    from optloc.files.one_call import locate
    from optloc.files.orbits import satellites
    from optloc.linear import constraints
    from optloc.linear.evaluate import predict
    from optloc.linear.gauss_newton import gauss_newton
    from optloc.linear.least_squares_ranges import reduce
    from optloc.linear.normal import Linear, Normal, linearise, normal
    from optloc.linear.simulate import simulate
    from optloc.linear.walks import wander
    from optloc.model_checks.advice import advise, explained
    from optloc.model_checks.coplanar import distance_from_plane
    from optloc.model_checks.determine import determined
    from optloc.model_checks.evidence import Reliability, reliability
    from optloc.model_checks.geometry import Advice
    from optloc.model_checks.noise_level import CommonLevel, LateSignals
    from optloc.models import MODELS, Model
    from optloc.models.medium import Atmosphere, Layers
    from optloc.multi_target import Emitters, separate
    from optloc.problem import epochs, noise
    from optloc.problem.bias import with_bias, with_known_bias
    from optloc.problem.build import assemble, measured, station_array
    from optloc.problem.chart import Chart
    from optloc.problem.clocks import clock_densities
    from optloc.problem.determined import Determined, Direction, Quantity
    from optloc.problem.epochs import by_epoch
    from optloc.problem.fix import Alternatives, Explanation, Fix, Stage, Suspect
    from optloc.problem.layout import Layout
    from optloc.problem.loss import LOSSES, Loss
    from optloc.problem.noise import Noise
    from optloc.problem.problem import Problem
    from optloc.problem.signal import Signal
    from optloc.sites.calibration.calibrated import Calibration, calibrate
    from optloc.sites.calibration.network import Network, network_of
    from optloc.sites.placement.chosen import Placement, place
    from optloc.sites.placement.sites import SiteSelection
    from optloc.solvers import FORMULATIONS, METHODS, SOLVERS, Formulation, solve
    from optloc.solvers.certificates.admitted import certify
    from optloc.solvers.prepared import Prepared, prepare
    from optloc.solvers.robust.stage import rejected
    from optloc.solvers.running import Running
    from optloc.solvers.shares import StatusShares, status_shares
    from optloc.solvers.suspect_rows.stage import suspects
    from optloc.station_health.levels import (
        NoiseLevels,
        common_level,
        late_signals,
        noise_levels,
        with_noise_levels,
    )
    from optloc.station_health.stations import Health, health
    from optloc.station_health.structure import NoiseStructure, noise_structure, with_estimated_noise
    from optloc.uncertainty.arc import Arc, trace_arc
    from optloc.uncertainty.posterior import Mixture, Samples, mixture, samples
    from optloc.uncertainty.radii import Accuracy, accuracy
    from optloc.uncertainty.region import Region, likelihood_region

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
    "Atmosphere",
    "Bias",
    "Budget",
    "Calibration",
    "Certificate",
    "Chart",
    "CommonLevel",
    "Course",
    "Determined",
    "Direction",
    "Emitters",
    "Explanation",
    "Fix",
    "Formulation",
    "Frame",
    "Health",
    "InvalidProblem",
    "LateSignals",
    "Layers",
    "Layout",
    "Linear",
    "Loss",
    "Mixture",
    "Model",
    "Motion",
    "Network",
    "NoSolution",
    "Noise",
    "NoiseLevels",
    "NoiseStructure",
    "Normal",
    "Observability",
    "OptlocError",
    "Placement",
    "Prepared",
    "Prior",
    "Problem",
    "Quantity",
    "Region",
    "Reliability",
    "Rows",
    "Running",
    "Samples",
    "Signal",
    "SiteSelection",
    "Stage",
    "Stations",
    "Status",
    "StatusShares",
    "Suspect",
    "accuracy",
    "advise",
    "assemble",
    "by_epoch",
    "calibrate",
    "certify",
    "clock_densities",
    "common_level",
    "constraints",
    "crlb",
    "crlb_course",
    "determined",
    "distance_from_plane",
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
    "network_of",
    "noise",
    "noise_levels",
    "noise_structure",
    "normal",
    "observability",
    "place",
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
    "status_shares",
    "suspects",
    "trace_arc",
    "units",
    "wander",
    "with_bias",
    "with_estimated_noise",
    "with_known_bias",
    "with_noise_levels",
]


# Where each public name lives; the imports above say the same to whoever checks types, a test holds both equal.
_HOMES = {
    "model_checks.advice": "advise explained",
    "model_checks.evidence": "Reliability reliability",
    "model_checks.geometry": "Advice",
    "model_checks.noise_level": "CommonLevel LateSignals",
    "base.errors": "InvalidProblem NoSolution OptlocError",
    "base.frames": "CARTESIAN ECEF Frame",
    "base.inputs": "Budget",
    "base.types": "Bias Certificate Motion Prior Rows Stations Status",
    "bounds.cramer_rao": "Course crlb crlb_course",
    "bounds.rank": "Observability observability",
    "sites.calibration.calibrated": "Calibration calibrate",
    "sites.calibration.network": "Network network_of",
    "files": "from_table load",
    "files.one_call": "locate",
    "files.orbits": "satellites",
    "linear.evaluate": "predict",
    "linear.gauss_newton": "gauss_newton",
    "linear.normal": "Linear Normal linearise normal",
    "linear.simulate": "simulate",
    "linear.walks": "wander",
    "models": "MODELS Model",
    "models.medium": "Atmosphere Layers",
    "sites.placement.chosen": "Placement place",
    "sites.placement.sites": "SiteSelection",
    "problem.bias": "with_bias with_known_bias",
    "problem.build": "assemble measured station_array",
    "problem.chart": "Chart",
    "problem.clocks": "clock_densities",
    "problem.determined": "Determined Direction Quantity",
    "problem.epochs": "by_epoch",
    "problem.fix": "Alternatives Explanation Fix Stage Suspect",
    "problem.layout": "Layout",
    "problem.loss": "LOSSES Loss",
    "problem.noise": "Noise",
    "problem.problem": "Problem",
    "problem.signal": "Signal",
    "station_health.stations": "Health health",
    "station_health.levels": "NoiseLevels common_level late_signals noise_levels with_noise_levels",
    "station_health.structure": "NoiseStructure noise_structure with_estimated_noise",
    "multi_target": "Emitters separate",
    "solvers": "FORMULATIONS METHODS SOLVERS Formulation solve",
    "solvers.certificates.admitted": "certify",
    "solvers.prepared": "Prepared prepare",
    "solvers.robust.stage": "rejected",
    "solvers.running": "Running",
    "solvers.shares": "StatusShares status_shares",
    "linear.least_squares_ranges": "reduce",
    "solvers.suspect_rows.stage": "suspects",
    "model_checks.coplanar": "distance_from_plane",
    "model_checks.determine": "determined",
    "uncertainty.arc": "Arc trace_arc",
    "uncertainty.posterior": "Mixture Samples mixture samples",
    "uncertainty.radii": "Accuracy accuracy",
    "uncertainty.region": "Region likelihood_region",
}
_MODULES = {
    "constraints": "optloc.linear.constraints",
    "epochs": "optloc.problem.epochs",
    "frames": "optloc.base.frames",
    "noise": "optloc.problem.noise",
    "units": "optloc.base.units",
}
_PLACE = {name: f"optloc.{place}" for place, names in _HOMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name in _PLACE:
        found = getattr(import_module(_PLACE[name]), name)
    elif name in _MODULES:
        found = import_module(_MODULES[name])
    elif not name.startswith("_") and find_spec(f"optloc.{name}") is not None:
        return import_module(f"optloc.{name}")  # a folder, such as `optloc.tracking`, is its own attribute from then on
    else:
        raise AttributeError(f"module 'optloc' has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


told_by(lambda: import_module("optloc.show.fixes"))


def _from_table(*args: Any, **options: Any) -> Problem:
    from optloc.files import from_table

    return from_table(*args, **options)


_from_table.__doc__ = "Return the problem of a long table with one row for each measurement; see `optloc.from_table`."
Problem.from_table = staticmethod(_from_table)  # type: ignore[attr-defined]  # files are a higher floor than Problem
