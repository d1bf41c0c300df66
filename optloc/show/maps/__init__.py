"""Interactive maps of HTML pages: projection, background, marks, layers, and pages of fixes, tracks and bounds.

A map works without a network: coastlines, borders and cities are files of this package. Positions on a map are
longitude and latitude in degrees, or x and y in metres if the frame is not on Earth.
"""
