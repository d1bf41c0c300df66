"""A feeder of Stone Soup: differences of single pairs become one scan with the covariance that they share."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator
from typing import Any

import numpy as np
from stonesoup.base import Property
from stonesoup.buffered_generator import BufferedGenerator
from stonesoup.feeder.base import DetectionFeeder
from stonesoup.types.detection import Detection

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.plugins.stonesoup.models import TDOA, arrival_covariance, values_of


class PairFeeder(DetectionFeeder):  # type: ignore[misc]  # untyped base
    """Groups the TDOA detections of an instant to one vector detection of each target.

    Rows that share a station share the error of its arrival: their covariance is D diag(arrival_sigma^2) D' plus that
    of each row's own noise. Without such own noise, pairs that close a loop say nothing new and are left out.
    """

    arrival_sigma: float = Property(doc="Standard deviation of each station's arrival, metres.")
    row_sigma: float = Property(default=0.0, doc="Standard deviation of the own noise of each row, metres.")
    label: str | None = Property(
        default=None, doc="Key of the metadata that tells targets apart; None: all pairs of an instant are of one."
    )

    @BufferedGenerator.generator_method  # type: ignore[untyped-decorator]
    def data_gen(self) -> Iterator[tuple[dt.datetime, set[Detection]]]:
        """Yield the times and the vector detections.

        Raises
        ------
        InvalidProblem
            For a detection that is no TDOA, or stations that differ within an instant.
        """
        for time, detections in self.reader:
            groups: dict[Any, list[Detection]] = {}
            for detection in detections:
                if not isinstance(detection.measurement_model, TDOA):
                    what = f"a detection has the measurement model {type(detection.measurement_model).__name__}"
                    raise InvalidProblem(what, "PairFeeder", "feed detections of the model TDOA")
                name = detection.metadata.get(self.label) if self.label else None
                groups.setdefault(name, []).append(detection)
            yield time, {self._joined(group) for group in groups.values()}

    def _joined(self, group: list[Detection]) -> Detection:
        group = sorted(group, key=lambda detection: np.atleast_2d(detection.measurement_model.pairs).tolist())
        models = [detection.measurement_model for detection in group]
        first = models[0]
        if any(not np.array_equal(model.stations, first.stations) for model in models):
            raise InvalidProblem("stations differ within an instant", "PairFeeder", "give all pairs the same stations")
        pairs = np.concatenate([np.atleast_2d(model.pairs) for model in models])
        z = np.concatenate([values_of(detection) for detection in group])
        kept = np.ones(len(z), dtype=bool) if self.row_sigma > 0.0 else _forest(pairs, len(first.stations))
        covariance = arrival_covariance(pairs[kept], self.arrival_sigma, len(first.stations))
        model = TDOA(
            ndim_state=first.ndim_state,
            mapping=first.mapping,
            noise_covar=covariance + self.row_sigma**2 * np.eye(len(covariance)),
            stations=first.stations,
            pairs=pairs[kept],
        )
        metadata = {key: value for detection in group for key, value in detection.metadata.items()}
        return Detection(z[kept][:, None], timestamp=group[0].timestamp, measurement_model=model, metadata=metadata)


def _forest(pairs: Array, stations: int) -> Array:
    """Return which pairs (m,) link stations that those before leave apart."""
    group, kept = np.arange(stations), np.zeros(len(pairs), dtype=bool)
    for i, (a, b) in enumerate(pairs):
        if group[a] != group[b]:
            kept[i] = True
            group[group == group[b]] = group[a]
    return kept
