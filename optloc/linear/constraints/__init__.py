"""Constraints and fences: functions for users to state them, and the faces on which an estimate may be.

A *level* is one bound of one constraint, satisfied with equality. A *face* is a set of levels that are satisfied
together. A *band* is a constraint ``lower <= g(x) <= upper``; its *quantity* is g.
"""

from optloc.linear.constraints.bound_sets import (
    bounds as bounds,
    conjunction as conjunction,
    exact as exact,
    face_of as face_of,
    faces as faces,
    finite_sides as finite_sides,
    is_conjunctive as is_conjunctive,
)
from optloc.linear.constraints.chance import chance as chance
from optloc.linear.constraints.cones import is_held as is_held
from optloc.linear.constraints.quantities import (
    bands_of as bands_of,
    bounded as bounded,
    decisive_epochs as decisive_epochs,
    for_target as for_target,
    holds_along as holds_along,
    is_exact as is_exact,
    is_of_one_target as is_of_one_target,
    needs_velocity as needs_velocity,
    quantity_at as quantity_at,
)
from optloc.linear.constraints.regions import (
    annulus as annulus,
    ball as ball,
    band as band,
    disc as disc,
    half_plane as half_plane,
    keep_out_ball as keep_out_ball,
    keep_out_disc as keep_out_disc,
    keep_out_polygon as keep_out_polygon,
    polygon as polygon,
    polyhedron as polyhedron,
    polyline as polyline,
    quantity as quantity,
    terrain as terrain,
)
from optloc.linear.constraints.single_bounds import (
    Face as Face,
    Level as Level,
    band_at as band_at,
    binds_position as binds_position,
    bound_of as bound_of,
    face_names as face_names,
    is_corner as is_corner,
    is_flat as is_flat,
    is_height as is_height,
    kind_of as kind_of,
    levels as levels,
    on_face as on_face,
    outwards as outwards,
    restore as restore,
    tangent_at as tangent_at,
)
from optloc.linear.constraints.statements import (
    acceleration as acceleration,
    box as box,
    height as height,
    reported as reported,
    separation as separation,
    speed as speed,
    turn_rate as turn_rate,
    visible as visible,
)
from optloc.linear.constraints.violation import (
    TOLERANCE as TOLERANCE,
    is_admitted as is_admitted,
    violation as violation,
    violation_names as violation_names,
    violation_of as violation_of,
)
from optloc.linear.fences import fence as fence
