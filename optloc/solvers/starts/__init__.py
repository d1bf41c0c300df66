"""Starts without a first guess, by kind of measurement."""
