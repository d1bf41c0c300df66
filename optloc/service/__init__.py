"""Live service: a stream of events with lines of rows or arrivals as input, and fixes and proofs as output."""
