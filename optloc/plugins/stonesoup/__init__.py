"""Plug-in for Stone Soup: measurement models, an initiator without a first guess, and a feeder for pairs.

After the installation of optloc, the plug-in is also available as ``stonesoup.plugins.optloc``. Stone Soup
can read and write all its classes as YAML.
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
    """Register the classes of this plug-in with a ``ruamel.yaml.YAML`` of Stone Soup.

    Parameters
    ----------
    yaml : ruamel.yaml.YAML
        The argument comes from Stone Soup, which finds this function by the entry point
        ``stonesoup.serialise.yaml``.
    """
    classes = {
        cls.__name__: cls for cls in (TDOA, GROA, AOATDOA, RangeRate, FDOA, TDOAFDOA, AnyRows, FixInitiator, PairFeeder)
    }

    # The tag of a class in a file contains its module. Read only the class name, so that old files work after a
    # class moves to another module.
    def construct(constructor: Any, suffix: str, node: Any) -> Any:
        """Return the object of a YAML node; `suffix` is its tag after the package name."""
        constructor.deep_construct = True
        (properties,) = constructor.construct_yaml_omap(node)  # the generator must run to its end
        return classes[suffix.rpartition(".")[2]](**properties)

    yaml.constructor.add_multi_constructor("!optloc.plugins.stonesoup.", construct)
