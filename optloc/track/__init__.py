"""Trackers: fixes in time, started by the fixes of `optloc.solve`."""

from optloc.track.constants import begun_with_constants, followed_with_constants
from optloc.track.dynamics import Dynamics, current_statistical, polynomial, singer
from optloc.track.entry import Entry, Rules
from optloc.track.measurement_space import lines, simplified
from optloc.track.run import collected, tracked
from optloc.track.start import begun, two_point
from optloc.track.track import State, Track, followed, predicted
from optloc.track.updates import UPDATES, Filter, Updated, ekf, gated, reweighted, whitened
from optloc.track.whole_run import fitted, posterior_bound, smoothed

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
