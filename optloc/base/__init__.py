"""What everything stands on: types, status, units, frames, arrays, linear algebra, registries."""
