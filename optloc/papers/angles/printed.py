"""The numbers that the paper prints in section 3, and the bounds that its scenes were found to have."""

from __future__ import annotations

STRAIGHT = (0.032, 0.0897, 0.176)
"""Simulation 1: root mean square errors of position (m), velocity (m/s) and acceleration (m/s^2)."""

WINDING = (0.16, 0.267, 0.47)
"""Simulation 2: the same."""
