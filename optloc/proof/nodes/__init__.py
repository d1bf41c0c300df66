"""Bounds over a box for each kind of node: ranges, rates, angles, ratios, logarithms, heights and linear forms."""
