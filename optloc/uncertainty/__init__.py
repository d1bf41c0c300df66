"""What a fix leaves open: the shape of its likelihood, regions, arcs and samples."""
