"""Statistics of stations from the residuals of many fixes: noise levels, biases, gross errors, noise structure."""

from typing import TYPE_CHECKING

from optloc.base.faces import exported

if TYPE_CHECKING:
    from optloc.station_health.levels import (
        NoiseLevels as NoiseLevels,
        common_level as common_level,
        late_signals as late_signals,
        noise_levels as noise_levels,
        with_noise_levels as with_noise_levels,
    )
    from optloc.station_health.stations import Health as Health, health as health
    from optloc.station_health.structure import (
        NoiseStructure as NoiseStructure,
        noise_structure as noise_structure,
        with_estimated_noise as with_estimated_noise,
    )

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
