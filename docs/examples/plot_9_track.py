"""
A track without a first state
=============================

The drive past five beacons again, now as a track. Its start is a fix of the first scans.
"""

from importlib.resources import files

from optloc.files import read
from optloc.show.pictures import plot_tracks
from optloc.show.pictures.track import PlottedTrack
from optloc.tracking.dynamics import polynomial
from optloc.tracking.run import tracked

problem = read(files("optloc") / "scenarios" / "run.toml").problem
entries = tuple(tracked(problem, polynomial(1, 1.0)))
figure = plot_tracks([PlottedTrack("target", problem, entries)], "A drive past five beacons")
