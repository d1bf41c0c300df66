"""Commands of the lab: studies and reproduced papers."""
