"""Fixes of one target by one compiled call: minima, covariance and measures of quality."""
