"""Several emitters at once: which rows of an epoch are whose, how many emitters there are, and where each is."""

from optloc.multi_target.answer import Emitters, Ghost, evenly
from optloc.multi_target.assign import separate
from optloc.tracking.associate import Clutter

__all__ = ["Clutter", "Emitters", "Ghost", "evenly", "separate"]
