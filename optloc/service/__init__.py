"""Live service: it reads events of measurements from a stream, and writes fixes and proofs.

An event is the set of rows (measurements) of one transmission of a target. `site` has the template of an event, and
`events` collects rows into events. `engine` computes fixes and proofs, and `tracks` computes tracks. `stream` connects
the threads, and `process` connects a stream to its sources, its output and signals.
"""
