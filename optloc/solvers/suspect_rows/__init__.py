"""Which stations, rows and priors contradict the rest."""
