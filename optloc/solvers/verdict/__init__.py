"""From refined candidates to a fix with a status."""
