"""Starting points without a guess, by kind of measurement."""
