"""Location of slow targets by one receiver with one illuminator: excess path, azimuth and elevation."""
