"""Studies: many trials of scenarios, noise levels and methods, with one table of results, on a laptop or a cluster.

`document` defines the study file. `design` divides the study into cells (a case with a method) and chunks of trials.
`simulation` simulates the trials of a case. `methods` solves them, with optloc or with one of the `baselines`. `trial`
scores each answer as one row. `execute` runs all chunks on processes or a cluster. `folder` stores the finished parts.
`summary` computes the statistics of a finished study.
"""
