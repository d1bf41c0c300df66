"""Several emitters at once: which rows of an epoch are whose, how many emitters there are, and where each is."""

from optloc.several.answer import Emitters, Ghost
from optloc.several.assign import separate
from optloc.several.false import evenly
from optloc.track.sets import Clutter

__all__ = ["Clutter", "Emitters", "Ghost", "evenly", "separate"]
