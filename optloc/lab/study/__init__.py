"""Studies: many trials of scenarios x noise levels x methods in one long table, from a laptop to a cluster.

From file to report: `document` is the study file; `design` cuts it into cells, a case with a method each, and chunks of
trials; `draws` draws the trials of a case; `methods` solves them, with optloc or one of the `baselines`; `trial` scores
them, a row each; `execute` does so for all chunks, wherever; `folder` keeps their parts; `summary` says what was found.
"""
