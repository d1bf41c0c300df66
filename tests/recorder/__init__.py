"""Record the fixes of one version of optloc, and compare the recordings of two versions.

`python -m recorder record OUT.jsonl` solves all cases by all methods.
`python -m recorder compare OLD.jsonl NEW.jsonl` lists the differences.
Run both before and after a change that must not alter fixes; the tests do not run them.
"""
