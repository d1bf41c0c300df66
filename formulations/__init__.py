"""Optimisation problems, one a file: arrays in, roots, cvxpy problems or CasADi programs out.

These modules are independent of files, units and stations; their arguments are scaled numbers of order one.
Importing the package loads numpy at most; cvxpy, clarabel and casadi are imported where they are used.
"""
