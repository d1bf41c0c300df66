"""A stream of events: lines of rows or arrivals in, fixes and proofs out, for as long as it runs."""
