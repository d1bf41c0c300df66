"""Commands of sites: placement and calibration."""
