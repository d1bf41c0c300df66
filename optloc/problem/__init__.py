"""Public types and functions of one estimation problem and its fix, such as `Problem`, `assemble` and `Fix`."""

from typing import TYPE_CHECKING

from optloc.base.faces import exported as exported

if TYPE_CHECKING:
    from optloc.base.errors import (
        InvalidProblem as InvalidProblem,
        NoSolution as NoSolution,
        OptlocError as OptlocError,
        check_once as check_once,
        nearest as nearest,
        no_station as no_station,
    )
    from optloc.base.frames import (
        CARTESIAN as CARTESIAN,
        ECEF as ECEF,
        Frame as Frame,
        check_geodetic as check_geodetic,
        ecef_to_geodetic as ecef_to_geodetic,
        geodetic_to_ecef as geodetic_to_ecef,
    )
    from optloc.base.plots import plot_of as plot_of
    from optloc.base.registry import (
        Registry as Registry,
        load_plugin as load_plugin,
        plugin_module as plugin_module,
        plugins as plugins,
    )
    from optloc.base.short_form import HasShortForm as HasShortForm, ShortForm as ShortForm
    from optloc.base.types import (
        ANSWERED as ANSWERED,
        PRECEDENCE as PRECEDENCE,
        Amount as Amount,
        Array as Array,
        Bias as Bias,
        Certificate as Certificate,
        Motion as Motion,
        Prior as Prior,
        Rows as Rows,
        Stations as Stations,
        Status as Status,
    )
    from optloc.base.units import (
        LARGEST as LARGEST,
        SI_UNIT as SI_UNIT,
        SPEED_OF_LIGHT as SPEED_OF_LIGHT,
        Conversion as Conversion,
    )
    from optloc.problem.arrival_times import as_arrivals as as_arrivals
    from optloc.problem.bias import with_bias as with_bias, with_known_bias as with_known_bias
    from optloc.problem.build import (
        Measured as Measured,
        assemble as assemble,
        measured as measured,
        station_array as station_array,
    )
    from optloc.problem.chart import Chart as Chart, quantile as quantile, tail_probability as tail_probability
    from optloc.problem.claims import GLOBAL as GLOBAL, PROOFS as PROOFS, UNKNOWN as UNKNOWN
    from optloc.problem.clocks import clock_densities as clock_densities
    from optloc.problem.determined import Determined as Determined, Direction as Direction, Quantity as Quantity
    from optloc.problem.epochs import (
        by_epoch as by_epoch,
        cut as cut,
        has_correlated_epochs as has_correlated_epochs,
        joined as joined,
        separable as separable,
        window as window,
        windows as windows,
    )
    from optloc.problem.explanations import Explanation as Explanation, Suspect as Suspect
    from optloc.problem.fix import Fix as Fix
    from optloc.problem.fix_parts import Active as Active, Alternatives as Alternatives, Stage as Stage
    from optloc.problem.forms import form_of as form_of
    from optloc.problem.layout import Layout as Layout, emission_name as emission_name, state_names as state_names
    from optloc.problem.loss import LOSSES as LOSSES, Loss as Loss
    from optloc.problem.noise import (
        Block as Block,
        Noise as Noise,
        arrivals as arrivals,
        dense as dense,
        group as group,
        independent as independent,
        variances as variances,
        whiten as whiten,
    )
    from optloc.problem.posed_answer import PosedAnswer as PosedAnswer, PosedSolution as PosedSolution
    from optloc.problem.problem import Problem as Problem
    from optloc.problem.signal import Signal as Signal

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
