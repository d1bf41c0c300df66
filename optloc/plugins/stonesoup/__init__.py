"""Plug-in for Stone Soup: measurement models, an initiator that needs no guess, and a feeder of pairwise differences.

Once optloc is installed, Stone Soup also offers it as ``stonesoup.plugins.optloc``, and its YAML reads and writes all
classes.
"""

from __future__ import annotations

from typing import Any

from optloc.plugins.stonesoup.initiator import FixInitiator, mixture_state
from optloc.plugins.stonesoup.models import (
    AOATDOA,
    FDOA,
    GROA,
    TDOA,
    TDOAFDOA,
    AnyRows,
    PairFeeder,
    RangeRate,
    RateMeasurement,
    StationMeasurement,
    arrival_covariance,
)

__all__ = [
    "AOATDOA",
    "FDOA",
    "GROA",
    "TDOA",
    "TDOAFDOA",
    "AnyRows",
    "FixInitiator",
    "PairFeeder",
    "RangeRate",
    "RateMeasurement",
    "StationMeasurement",
    "arrival_covariance",
    "mixture_state",
    "register_yaml",
]


def register_yaml(yaml: Any) -> None:
    """Teach a ``ruamel.yaml.YAML`` of Stone Soup the classes of this plug-in.

    Parameters
    ----------
    yaml : ruamel.yaml.YAML
        Given by Stone Soup, which finds this function by the entry point ``stonesoup.serialise.yaml``.
    """
    classes = {
        cls.__name__: cls for cls in (TDOA, GROA, AOATDOA, RangeRate, FDOA, TDOAFDOA, AnyRows, FixInitiator, PairFeeder)
    }

    # Stone Soup writes the module of a class into its tag; the class alone is read, so files outlive moves.
    def construct(constructor: Any, suffix: str, node: Any) -> Any:
        constructor.deep_construct = True
        (properties,) = constructor.construct_yaml_omap(node)  # a generator that must be exhausted
        return classes[suffix.rpartition(".")[2]](**properties)

    yaml.constructor.add_multi_constructor("!optloc.plugins.stonesoup.", construct)
