"""Plug-ins for other programs; each is imported by the program that it is for."""
