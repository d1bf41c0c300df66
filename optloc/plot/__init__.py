"""Pictures: fixes with their stations, tracks, and the Cramer-Rao bound against time.

matplotlib is imported where it is used. Colours are those of Okabe and Ito, and every kind of point has its own mark.
"""

from optloc.plot.course import plot_course
from optloc.plot.fixes import plot_fixes
from optloc.plot.style import save
from optloc.plot.track import plot_tracks

__all__ = ["plot_course", "plot_fixes", "plot_tracks", "save"]
