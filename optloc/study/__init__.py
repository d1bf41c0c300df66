"""Studies: many trials of scenarios x noise levels x methods in one long table, from a laptop to a cluster."""
