"""Fixes of one target by one compiled call: minima, covariance and measures of quality."""

from typing import TYPE_CHECKING

from optloc.base.faces import exported

if TYPE_CHECKING:
    from optloc.base import arrays as arrays, linalg as linalg
    from optloc.base.arrays import numbers as numbers
    from optloc.base.cache import Cache as Cache
    from optloc.base.linalg import centre_and_spread as centre_and_spread
    from optloc.base.threads import WORTH as WORTH, map_on_threads as map_on_threads
    from optloc.engine.shape import STRAIGHT as STRAIGHT
    from optloc.kernels.equations import normal_at as normal_at, normal_block as normal_block
    from optloc.kernels.jit import (
        FEW as FEW,
        compiled as compiled,
        enabled as enabled,
        may_use_code as may_use_code,
        put as put,
        put_rows as put_rows,
    )
    from optloc.kernels.least_squares import WEIGHINGS as WEIGHINGS, Refined as Refined, refine as refine
    from optloc.kernels.pack import pack as pack
    from optloc.kernels.sums import equations_at as equations_at
    from optloc.kernels.systems import cholesky as cholesky, solve_factored as solve_factored
    from optloc.linear.constraints import (
        TOLERANCE as TOLERANCE,
        box as box,
        exact as exact,
        height as height,
        violation as violation,
        visible as visible,
    )
    from optloc.linear.evaluate import differentiate as differentiate, predict as predict
    from optloc.linear.gauss_newton import gauss_newton as gauss_newton
    from optloc.linear.least_squares_ranges import reduce as reduce
    from optloc.linear.mirror import one_position as one_position
    from optloc.linear.normal import (
        Linear as Linear,
        Normal as Normal,
        covariance as covariance,
        depends_on_place as depends_on_place,
        eliminated as eliminated,
        linearise as linearise,
        normal as normal,
        prior_parts as prior_parts,
        step as step,
        with_priors as with_priors,
        with_station_noise as with_station_noise,
    )
    from optloc.linear.redundancy import degrees_of_freedom as degrees_of_freedom
    from optloc.linear.simulate import simulate as simulate
    from optloc.linear.vectors import vectors as vectors
    from optloc.linear.walks import simulate_walks as simulate_walks, walks as walks

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
