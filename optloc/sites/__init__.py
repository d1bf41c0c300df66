"""Positions of stations: choice of sites (placement) and self-calibration of networks (calibration)."""

from typing import TYPE_CHECKING

from optloc.problem import exported

if TYPE_CHECKING:
    from optloc.sites import calibration as calibration, placement as placement
    from optloc.sites.site_plots import calibration_axes as calibration_axes, placement_axes as placement_axes

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
