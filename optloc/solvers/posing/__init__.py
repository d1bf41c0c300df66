"""Optimisation problems of optloc in the open: to read, to change and to solve."""
