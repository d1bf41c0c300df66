"""Output for people and other programs: text, HTML pages, pictures, maps and result files.

The package formats fixes, tracks, bounds and study reports. HTML pages need no network.
"""

from typing import TYPE_CHECKING

from optloc.base.faces import exported

if TYPE_CHECKING:
    from optloc.show.drawing import (
        SIZE as SIZE,
        Drawing as Drawing,
        Look as Look,
        Looks as Looks,
        Picture as Picture,
        inline as inline,
        marks as marks,
        panel as panel,
        panels as panels,
        svg_text as svg_text,
        with_legend as with_legend,
    )
    from optloc.show.fix_answer import FixSheet as FixSheet
    from optloc.show.formats import FORMATS as FORMATS, write_fixes as write_fixes
    from optloc.show.formats.marks import Mark as Mark, Other as Other, ellipse95 as ellipse95, mark_of as mark_of
    from optloc.show.maps.bound_page import map_element as map_element, map_page as map_page
    from optloc.show.maps.canvas import Canvas as Canvas
    from optloc.show.maps.live_marks import live_mark as live_mark
    from optloc.show.maps.map_pages import fix_page as fix_page, live_page as live_page, track_page as track_page
    from optloc.show.page import PagePart as PagePart, write_page as write_page
    from optloc.show.pictures.bound_map import (
        BOUND as BOUND,
        COLOURS as COLOURS,
        levels as levels,
        map_geojson as map_geojson,
        plot_bound_map as plot_bound_map,
        plot_status_map as plot_status_map,
        status_geojson as status_geojson,
    )
    from optloc.show.pictures.fix_axes import fix_axes as fix_axes, problem_axes as problem_axes
    from optloc.show.pictures.fixes import plot_fixes as plot_fixes
    from optloc.show.pictures.landscape import plot_convergence as plot_convergence, plot_landscape as plot_landscape
    from optloc.show.pictures.notes import separate_notes as separate_notes
    from optloc.show.pictures.outlines import earth_points as earth_points
    from optloc.show.pictures.residuals import plot_health as plot_health, plot_residuals as plot_residuals
    from optloc.show.pictures.runs import (
        plot_accuracy as plot_accuracy,
        plot_biases as plot_biases,
        plot_course as plot_course,
    )
    from optloc.show.pictures.style import (
        BLACK as BLACK,
        BLUE as BLUE,
        GREEN as GREEN,
        GREY as GREY,
        ORANGE as ORANGE,
        PURPLE as PURPLE,
        SMALL as SMALL,
        WIDE as WIDE,
        axes_or_new as axes_or_new,
        description as description,
        figure_class as figure_class,
        literal as literal,
        save as save,
    )
    from optloc.show.pictures.track import plot_tracks as plot_tracks
    from optloc.show.pictures.track_axes import track_axes as track_axes
    from optloc.show.sheet import ABSENT as ABSENT, Sheet as Sheet, TextTable as TextTable

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
