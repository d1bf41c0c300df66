"""Uncertainty beyond a covariance: regions, arcs, samples, mixtures and the radii of data sheets."""

from typing import TYPE_CHECKING

from optloc.base.faces import exported

if TYPE_CHECKING:
    from optloc.uncertainty.arc import Arc as Arc, trace_arc as trace_arc
    from optloc.uncertainty.posterior import (
        Mixture as Mixture,
        Samples as Samples,
        mixture as mixture,
        samples as samples,
    )
    from optloc.uncertainty.radii import Accuracy as Accuracy, accuracy as accuracy, radius as radius
    from optloc.uncertainty.region import Cells as Cells, Region as Region, likelihood_region as likelihood_region

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
