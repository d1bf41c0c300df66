"""Robust fits: minima of losses that limit the effect of gross errors."""
