"""Optimisation problems, one a file: arrays in, roots, cvxpy problems or CasADi programs out.

The ground floor: these modules know nothing of files, units or stations and see scaled numbers of order one only.
Importing the package loads numpy at most; cvxpy, clarabel and casadi are imported where they are used.
"""
