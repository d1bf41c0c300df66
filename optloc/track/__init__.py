"""Trackers: fixes in time, started by the fixes of `optloc.solve`."""

from optloc.track.dynamics import Dynamics, current_statistical, polynomial, singer
from optloc.track.start import begun
from optloc.track.track import State, Track, followed, predicted
from optloc.track.updates import UPDATES

__all__ = [
    "UPDATES",
    "Dynamics",
    "State",
    "Track",
    "begun",
    "current_statistical",
    "followed",
    "polynomial",
    "predicted",
    "singer",
]
