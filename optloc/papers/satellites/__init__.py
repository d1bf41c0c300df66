"""Tracking of ships by the time differences of three satellites and a known height: four Kalman filters."""
