"""Whether what is assumed holds: of a covariance that it covers, of a model that it fits."""
