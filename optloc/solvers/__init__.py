"""Methods from a problem to a fix, without a guess; proofs, robust losses and suspects."""

from typing import TYPE_CHECKING

from optloc.base.faces import exported

if TYPE_CHECKING:
    from optloc.linear.vectors import vectors as vectors
    from optloc.solvers.back_ends import (
        Backend as Backend,
        backend_kind as backend_kind,
        backends as backends,
        kind_of as kind_of,
        version_of as version_of,
    )
    from optloc.solvers.certificates.admitted import certify as certify
    from optloc.solvers.certificates.relaxations import Reference as Reference, reference_bound as reference_bound
    from optloc.solvers.floors import PreparedFloors as PreparedFloors, prepare_on_floors as prepare_on_floors
    from optloc.solvers.methods import (
        FORMULATIONS as FORMULATIONS,
        METHODS as METHODS,
        SOLVERS as SOLVERS,
        Choice as Choice,
        Formulation as Formulation,
        Method as Method,
        SolverEntry as SolverEntry,
        counting as counting,
        shortcut as shortcut,
        using as using,
    )
    from optloc.solvers.outside import given as given, judge_points as judge_points
    from optloc.solvers.policy import (
        AMBIGUOUS_GAP as AMBIGUOUS_GAP,
        LISTED_GAP as LISTED_GAP,
        P_MISFIT as P_MISFIT,
        equal_cost as equal_cost,
    )
    from optloc.solvers.pool import Pool as Pool, begin as begin, offer as offer
    from optloc.solvers.posing.convex_program import ConvexProgram as ConvexProgram
    from optloc.solvers.posing.posed import Posed as Posed
    from optloc.solvers.posing.posed_problem import PosedProblem as PosedProblem
    from optloc.solvers.posing.range_moments import range_rows as range_rows
    from optloc.solvers.prepared import Prepared as Prepared, prepare as prepare
    from optloc.solvers.robust.stage import rejected as rejected
    from optloc.solvers.running import Running as Running
    from optloc.solvers.shares import StatusShares as StatusShares, status_shares as status_shares
    from optloc.solvers.solution import solve as solve
    from optloc.solvers.starts.angles import course_starts as course_starts, courses as courses
    from optloc.solvers.starts.block_averages import average_blocks as average_blocks
    from optloc.solvers.starts.position import spread_of as spread_of
    from optloc.solvers.suspect_rows.stage import suspects as suspects
    from optloc.solvers.verdict.findings import Finding as Finding, objections as objections
    from optloc.solvers.verdict.judge import judge as judge

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
