"""Error registration of several moving stations by time differences and gain ratios: section 4 of the paper."""
