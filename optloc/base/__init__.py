"""Basic modules of all other packages: types, status, units, frames, arrays, linear algebra, registries."""
