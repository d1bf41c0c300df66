"""Proofs that no position costs less: enclosure, convex box, branch and bound."""
