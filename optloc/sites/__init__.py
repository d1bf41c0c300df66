"""Where stations stand: networks of unknown places, and the choice of sites."""
