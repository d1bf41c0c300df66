"""Plug-ins for other programs. The other program imports its plug-in."""
