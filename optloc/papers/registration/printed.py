"""The numbers that the paper prints in section 4."""

from __future__ import annotations

SIGMA0 = (1855.0, 2758.0, 160.0)
"""Coordinates of the one-shot bound, metres."""

ACCURACY_FIXED = {
    150: (99.60, 89.38, 92.10, 86.65),
    200: (99.72, 95.44, 96.97, 94.80),
    300: (99.97, 98.42, 99.36, 99.02),
    400: (99.99, 99.29, 99.98, 99.86),
}
"""Table 2: accuracy of the four biases at given seconds, per cent."""

INITIAL = {1: (39.3, 0.0), 5: (37.1, 0.0), 10: (36.7, 0.0), 15: (37.8, 0.0), 20: (38.0, 2.5)}
"""Table 3: root mean square error in metres and divergence in per cent, for starts n sigma0 wide."""

NOISE = {20: (39.3, 36.7, 0.0), 30: (74.6, 73.3, 1.0), 40: (120.6, 110.0, 8.5), 50: (153.6, 146.7, 15.0)}
"""Table 4: error and bound in metres and divergence in per cent, for a noise labelled in nanoseconds."""

BOUND = 36.7
"""The bound of table 3, metres."""

ACCURACY_MOVING = {
    300: (92.78, 87.11, 0.00, 0.00),
    400: (94.32, 95.73, 0.00, 0.00),
    550: (99.14, 99.34, 87.71, 79.19),
    700: (99.92, 99.68, 95.69, 93.08),
}
"""Table 5: the same as table 2 for the moving target."""

ACCURACY_JOINT = {
    150: (99.50, 97.39, 98.17, 96.89, 99.88, 99.97, 99.97, 99.93),
    200: (99.81, 99.68, 99.98, 99.96, 99.96, 99.97, 99.97, 99.94),
    300: (99.98, 98.04, 98.13, 96.91, 99.98, 99.96, 99.96, 99.96),
    400: (99.94, 99.51, 99.23, 98.69, 99.99, 99.99, 99.98, 99.98),
}
"""Table 6: the same with gain ratios, four delays and four gains."""

FIXED = {"5 m": 75.0, "1 m": 39.0}
MOVING = {"1 m": 633.0}
JOINT = {"5 m": 71.0, "1 m": 36.0}
"""Root mean square errors at 600 s that the text of section 4 names, metres, by station error."""
