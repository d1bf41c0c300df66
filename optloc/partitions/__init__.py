"""Fixes of large data sets: one partition at a time, in this process, on a Dask cluster or on Ray."""
