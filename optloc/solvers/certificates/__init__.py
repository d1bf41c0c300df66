"""Certificates of fixes: proofs by branch and bound, and bounds from relaxations."""
