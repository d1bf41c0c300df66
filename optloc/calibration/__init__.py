"""Self-calibration: stations, clocks and emitters unknown together."""

from optloc.calibration.calibrate import Alternative, Calibration, calibrate
from optloc.calibration.network import Network, Slot, network

__all__ = ["Alternative", "Calibration", "Network", "Slot", "calibrate", "network"]
