"""The commands ``optloc place`` and ``optloc calibrate``."""
