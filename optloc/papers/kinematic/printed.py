"""The numbers that the paper prints in its table 1."""

from __future__ import annotations

ERROR = {"static": 0.982, "CV on CV": 0.591, "CV on CA": 10.618, "CA on CA": 0.781}
"""Mean position error, kilometres: static algorithm and target, and scenes 1 to 3."""

SECONDS = {"static": 0.402, "CV on CV": 0.444, "CV on CA": 0.467, "CA on CA": 0.450}
"""Computing time, milliseconds."""
