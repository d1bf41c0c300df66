"""Where to put stations: which of many sites to take, with a bound of what any choice can reach."""

from optloc.sites.placement.chosen import Draws, Placement, Swap, picture, place
from optloc.sites.placement.sites import CountGroup, SiteSelection

__all__ = ["CountGroup", "Draws", "Placement", "SiteSelection", "Swap", "picture", "place"]
