"""Explanations of a fix that you cannot use without further checks."""

from typing import TYPE_CHECKING

from optloc.base.faces import exported

if TYPE_CHECKING:
    from optloc.advice.advising import advise as advise
    from optloc.advice.diagnosis import Diagnosis as Diagnosis, diagnose as diagnose
    from optloc.advice.explanation_table import EXPLANATIONS as EXPLANATIONS, PossibleCause as PossibleCause
    from optloc.model_checks.cause import Advice as Advice
    from optloc.model_checks.single_error import explained as explained

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
