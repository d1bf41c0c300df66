"""Tests of the measurement model: noise levels, systematic errors, unit mistakes, geometry, Gaussian shape."""

from typing import TYPE_CHECKING

from optloc.base.faces import exported

if TYPE_CHECKING:
    from optloc.model_checks.cause import Advice as Advice
    from optloc.model_checks.coplanar import distance_from_plane as distance_from_plane
    from optloc.model_checks.determine import determined as determined
    from optloc.model_checks.evidence import Reliability as Reliability, reliability as reliability
    from optloc.model_checks.noise_level import CommonLevel as CommonLevel, LateSignals as LateSignals
    from optloc.model_checks.plausibility import (
        least_values as least_values,
        refuse_impossible as refuse_impossible,
        suspicious_values as suspicious_values,
    )
    from optloc.model_checks.single_error import explained as explained

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
