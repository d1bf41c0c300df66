"""Fits that gross errors do not pull."""
