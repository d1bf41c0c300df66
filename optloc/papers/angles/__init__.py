"""Tracking by azimuth and elevation with the current statistical model: section 3 of the paper."""
