"""What a proof knows of each kind of measurement over a box."""
