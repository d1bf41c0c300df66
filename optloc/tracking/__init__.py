"""Trackers: fixes in time, started by the fixes of `optloc.solve`."""

from optloc.tracking.constants import begun_with_constants, followed_with_constants
from optloc.tracking.dynamics import Dynamics, current_statistical, polynomial, singer
from optloc.tracking.entry import Entry, Rules
from optloc.tracking.measurement_space import lines, simplified
from optloc.tracking.run import collected, tracked
from optloc.tracking.start import begun, two_point
from optloc.tracking.track import State, Track, followed, predicted
from optloc.tracking.updates import UPDATES, Filter, Updated, ekf, gated, reweighted, whitened
from optloc.tracking.whole_run import fitted, posterior_bound, smoothed

__all__ = [
    "UPDATES",
    "Dynamics",
    "Entry",
    "Filter",
    "Rules",
    "State",
    "Track",
    "Updated",
    "begun",
    "begun_with_constants",
    "collected",
    "current_statistical",
    "ekf",
    "fitted",
    "followed",
    "followed_with_constants",
    "gated",
    "lines",
    "polynomial",
    "posterior_bound",
    "predicted",
    "reweighted",
    "simplified",
    "singer",
    "smoothed",
    "tracked",
    "two_point",
    "whitened",
]
