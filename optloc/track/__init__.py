"""Trackers: fixes in time, started by the fixes of `optloc.solve`."""

from optloc.track.batch import fitted, smoothed
from optloc.track.bound import posterior_bound
from optloc.track.dynamics import Dynamics, current_statistical, polynomial, singer
from optloc.track.run import Entry, Rules, collected, tracked
from optloc.track.start import begun
from optloc.track.track import State, Track, followed, predicted
from optloc.track.updates import UPDATES

__all__ = [
    "UPDATES",
    "Dynamics",
    "Entry",
    "Rules",
    "State",
    "Track",
    "begun",
    "collected",
    "current_statistical",
    "fitted",
    "followed",
    "polynomial",
    "posterior_bound",
    "predicted",
    "singer",
    "smoothed",
    "tracked",
]
