"""The proof of runs: rows by the hundred of a target that stays."""
