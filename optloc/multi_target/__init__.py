"""Several emitters in one epoch: the number of emitters, the position of each, and the assignment of rows to them."""

from typing import TYPE_CHECKING

from optloc.base.faces import exported

if TYPE_CHECKING:
    from optloc.multi_target.answer import Emitters as Emitters, Ghost as Ghost, evenly as evenly
    from optloc.multi_target.assign import separate as separate
    from optloc.multi_target.pricing_search import (
        PricedRegion as PricedRegion,
        PricingResult as PricingResult,
        search as search,
    )
    from optloc.multi_target.set_packing import (
        Prices as Prices,
        cheapest_sets as cheapest_sets,
        price_rows as price_rows,
    )
    from optloc.multi_target.sets import Scene as Scene
    from optloc.tracking.associate import Clutter as Clutter

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
