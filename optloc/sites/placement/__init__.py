"""Sensor placement: the best set of sites from a list of candidates, with a proven bound for all other sets."""

from optloc.sites.placement.chosen import Draws, Placement, Swap, picture, place
from optloc.sites.placement.posed_placement import PosedPlacement, RelaxedPlacement, pose_placement
from optloc.sites.placement.sites import CountGroup, SiteSelection

__all__ = [
    "CountGroup",
    "Draws",
    "Placement",
    "PosedPlacement",
    "RelaxedPlacement",
    "SiteSelection",
    "Swap",
    "picture",
    "place",
    "pose_placement",
]
