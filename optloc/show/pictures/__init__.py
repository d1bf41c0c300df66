"""Pictures of fixes, cost landscapes, convergence, residuals, biases, tracks, bounds and errors of methods.

The modules import matplotlib inside functions, so that other commands do not load it. The colours are the palette of
Okabe and Ito, and each kind of point has a different mark.
"""

from optloc.show.pictures.bound_map import map_geojson, plot_bound_map, plot_status_map, status_geojson
from optloc.show.pictures.fixes import plot_fixes
from optloc.show.pictures.landscape import plot_convergence, plot_landscape
from optloc.show.pictures.residuals import plot_health, plot_residuals
from optloc.show.pictures.runs import plot_accuracy, plot_biases, plot_course
from optloc.show.pictures.style import save
from optloc.show.pictures.track import plot_tracks

__all__ = [
    "map_geojson",
    "plot_accuracy",
    "plot_biases",
    "plot_bound_map",
    "plot_convergence",
    "plot_course",
    "plot_fixes",
    "plot_health",
    "plot_landscape",
    "plot_residuals",
    "plot_status_map",
    "plot_tracks",
    "save",
    "status_geojson",
]
