"""Search for suspects: the stations, rows and priors that contradict the other data."""
