"""What the data say beyond a covariance: regions, arcs, samples, mixtures and the radii of data sheets."""
