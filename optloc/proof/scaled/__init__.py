"""Proofs of costs with unknown factors of rows: the speed of a wave, or the velocity of the target."""
