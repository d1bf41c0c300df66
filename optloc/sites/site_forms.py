"""Short forms of networks, calibrations and placements; see `optloc.problem.ShortForm`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.problem import ShortForm

if TYPE_CHECKING:
    from optloc.sites.calibration.calibrated import Calibration
    from optloc.sites.calibration.network import Network
    from optloc.sites.calibration.posed_network import PosedNetwork
    from optloc.sites.placement.chosen import Placement
    from optloc.sites.placement.posed_placement import PosedPlacement

Rows = list[tuple[str, str]]


def _listed(names: Sequence[str], most: int = 4) -> str:
    """Return names as text; of many names, the first names and the number of the others."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _network(network: Network) -> ShortForm:
    """Return the short form of a network: measurements, known positions, clocks and unknowns."""
    given, m = network.given, network.stations
    kinds = Counter[str]()
    for slot, count in zip(network.slots, given.sum(axis=0).tolist(), strict=True):
        kinds[slot.kind] += count
    known = int(np.isfinite(network.place_sigma).all(axis=1).sum())
    rows: Rows = [
        ("stations", f"{_listed(network.names)}; positions of {known} of {m} are known"),
        ("rows", ", ".join(f"{count} {kind}" for kind, count in kinds.items())),
    ]
    rows += [("distances", f"{len(network.distance)} between stations")] if len(network.distance) else []
    rows.append(("clocks", "shared" if network.synchronised else "one unknown offset for each station"))
    rows.append(("unknowns", f"{network.unknowns}, with {network.rows} rows and prior coordinates"))
    title = f"Network: {m} stations, {network.pulses} pulses, {network.dimension} dimensions"
    return ShortForm(title, tuple(rows), "optloc.calibrate(network)")


def _calibration(one: Calibration) -> ShortForm:
    """Return the short form of a calibration: status, accuracy of the stations, fit and alternatives."""
    m, d = one.stations.shape
    rows: Rows = [("status", one.status.label), *(("reason", text) for text in one.findings[:3])]
    sigma = np.sqrt(np.sum(one.sigma**2, axis=1))
    known = sigma[np.isfinite(sigma)]
    accuracy = f"median {np.median(known):.3g} m, largest {known.max():.3g} m" if len(known) else "not determined"
    rows.append(("sigma", f"{accuracy} (root of the trace for each station)"))
    rows.append(("frame", one.gauge))
    rows.append(("chi-square", f"{one.cost:.4g} with {one.dof} degrees of freedom, p = {one.p_value:.3g}"))
    rows.append(("certificate", f"{one.proof}; {one.agreeing} of {one.starts} starts reached this network"))
    rows += [("alternatives", str(len(one.alternatives)))] if one.alternatives else []
    rows += [("left out", f"{len(one.left_out)} rows")] if len(one.left_out) else []
    found = int(np.isfinite(one.pulses).all(axis=1).sum())
    title = f"Calibration: {m} stations and {found} of {len(one.pulses)} pulses, {d} dimensions"
    return ShortForm(title, tuple(rows), "calibration.stations, calibration.sigma, calibration.require()")


def _placement(placement: Placement) -> ShortForm:
    """Return the short form of a placement: chosen sites, criterion, proof, weakest place and most needed site."""
    proof = "proven" if placement.closed else "not closed"
    rows: Rows = [("new sites", _listed(placement.chosen, 8) or "none")]
    rows += [("kept sites", _listed(placement.kept, 8))] if placement.kept else []
    rows.append((f"criterion {placement.criterion}", f"{placement.sigma:.4g} m (root)"))
    rows.append(("bound", f"at most {100.0 * placement.gap:.3g} % better is possible; {proof}"))
    rows.append(("reason", placement.reason))
    known = placement.per_place[np.isfinite(placement.per_place)]
    if len(known):
        rows.append(("places", f"{len(placement.per_place)}: error {known.min():.4g} to {known.max():.4g} m"))
    if placement.swaps:
        rows.append(("largest loss", f"{placement.swaps[0].name}: then {np.sqrt(placement.swaps[0].value):.4g} m"))
    rows += [("next site", placement.following[0][0])] if placement.following else []
    title = f"Placement: {len(placement.chosen)} new sites, {len(placement.kept)} kept"
    return ShortForm(title, tuple(rows), "placement.alternatives, placement.swaps, placement.per_place")


def _posed_placement(posed: PosedPlacement) -> ShortForm:
    """Return the short form of a placement as a posed problem."""
    rows: Rows = [("sites", _listed(posed.names)), ("size", _size(posed.problem))]
    return ShortForm(f"Posed placement: {len(posed.names)} sites", tuple(rows), "posed.add(...), posed.solve()")


def _posed_network(posed: PosedNetwork) -> ShortForm:
    """Return the short form of a network as a posed problem."""
    rows: Rows = [("size", _size(posed.problem))]
    title = f"Posed network: {posed.emission.size} times of emission"
    return ShortForm(title, tuple(rows), "posed.add(...), posed.minimise(...), posed.solve()")


def _size(problem: Any) -> str:
    """Return the number of variables and constraints of a cvxpy problem as text."""
    count = sum(variable.size for variable in problem.variables())
    return f"{count} variables, {len(problem.constraints)} constraints (cvxpy)"


FORMS: dict[str, Callable[[Any], ShortForm]] = {
    "Network": _network,
    "Calibration": _calibration,
    "Placement": _placement,
    "PosedPlacement": _posed_placement,
    "PosedNetwork": _posed_network,
}
"""Short forms of the values of this folder, by the name of the class."""
