"""policy."""

from __future__ import annotations

LISTED_GAP = 25.0


AMBIGUOUS_GAP = 9.0


DOUBT = 1e-3


# Spreads of the stations: from here on a fix must be a good one, and from there on every wave front is flat.
FAR, FLAT = 1e4, 1e6
