"""Proofs that no position costs less than a fix: enclosure, convex box, branch and bound."""
