"""Self-calibration of networks: unknown stations, clocks and emitters are estimated together."""

from optloc.sites.calibration.calibrated import Alternative, Calibration, calibrate
from optloc.sites.calibration.network import Network, NetworkSlot, network_of

__all__ = ["Alternative", "Calibration", "Network", "NetworkSlot", "calibrate", "network_of"]
