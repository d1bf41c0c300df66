"""Self-calibration of networks: unknown stations, clocks and emitters are estimated together."""

from optloc.sites.calibration.calibrated import Alternative, Calibration, calibrate
from optloc.sites.calibration.network import Network, NetworkSlot
from optloc.sites.calibration.network_arguments import network_of
from optloc.sites.calibration.posed_network import PosedNetwork, RelaxedNetwork, pose_network

__all__ = [
    "Alternative",
    "Calibration",
    "Network",
    "NetworkSlot",
    "PosedNetwork",
    "RelaxedNetwork",
    "calibrate",
    "network_of",
    "pose_network",
]
