"""Proofs of runs: many epochs with hundreds of rows, of a target that stays or moves uniformly."""
