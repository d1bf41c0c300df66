"""Pictures: fixes with their stations, tracks, the Cramer-Rao bound against time and as a map.

matplotlib is imported where it is used. Colours are those of Okabe and Ito, and every kind of point has its own mark.
"""

from optloc.plot.bound_map import map_geojson, plot_bound_map
from optloc.plot.course import plot_course
from optloc.plot.fixes import plot_fixes
from optloc.plot.style import save
from optloc.plot.track import plot_tracks

__all__ = ["map_geojson", "plot_bound_map", "plot_course", "plot_fixes", "plot_tracks", "save"]
