"""Accuracy limits of a fix: the Cramer-Rao bound, observability, and maps of the bound."""

from typing import TYPE_CHECKING

from optloc.base.faces import exported

if TYPE_CHECKING:
    from optloc.bounds.cramer_rao import Course as Course, crlb as crlb, crlb_course as crlb_course
    from optloc.bounds.over_area import (
        BoundMap as BoundMap,
        Grid as Grid,
        bound_map as bound_map,
        extent as extent,
        grid_of as grid_of,
        map_coordinates as map_coordinates,
    )
    from optloc.bounds.rank import Observability as Observability, observability as observability

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
