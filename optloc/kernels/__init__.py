"""Compiled forms of the batch computations, derived from the same measurement functions as the numpy path."""
