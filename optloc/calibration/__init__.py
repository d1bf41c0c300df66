"""Self-calibration: stations, clocks and emitters unknown together."""

from optloc.calibration.calibrated import Alternative, Calibration, calibrate
from optloc.calibration.network import Network, Slot, network_of

__all__ = ["Alternative", "Calibration", "Network", "Slot", "calibrate", "network_of"]
