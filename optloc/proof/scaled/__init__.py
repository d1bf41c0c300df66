"""Proofs of costs with one unknown factor of all rows, such as the speed of a wave."""
