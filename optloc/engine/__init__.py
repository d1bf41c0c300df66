"""Fixes of one target by one compiled call: minima, covariance, and what tells how good they are."""
