"""Methods: pipelines of stages, written as words such as "gtrs+lsr"."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from formulations.backend import Choice, Ending, Kind, counting, recording, using
from optloc.base.errors import InvalidProblem, nearest
from optloc.base.records import take
from optloc.base.registry import Registry
from optloc.base.types import Array, Certificate, Status
from optloc.engine.plan import plan_of
from optloc.problem.claims import GLOBAL, REGION, Claims, claim
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Stage
from optloc.problem.loss import LOSSES
from optloc.problem.problem import Problem
from optloc.proof.scope import is_run, is_scaled, why_unsupported
from optloc.solvers import stages
from optloc.solvers.certificates.admitted import certified, value_certified
from optloc.solvers.certificates.branch_and_bound import claims_before, tried_before
from optloc.solvers.formulations import FORMULATIONS, Formulation
from optloc.solvers.outside import FixSolver, adapt
from optloc.solvers.planned import PlannedStages
from optloc.solvers.policy import LISTED_GAP
from optloc.solvers.pool import Pool, noting_place, offer, pack
from optloc.solvers.robust.stage import Robust
from optloc.solvers.sparse import sparse
from optloc.solvers.stages import Solver
from optloc.solvers.suspect_rows.stage import suspect
from optloc.solvers.verdict.judge import judge, surviving_candidates

# `Choice`, `Kind`, `counting` and `using` of `formulations.backend` are exported here for layers that do not import
# `formulations`.
__all__ = [
    "FORMULATIONS",
    "METHODS",
    "SOLVERS",
    "Choice",
    "Formulation",
    "Kind",
    "Method",
    "SolverEntry",
    "counting",
    "using",
]


@dataclass(frozen=True, slots=True)
class SolverEntry:
    """A solver stage.

    Parameters
    ----------
    solver : callable
        ``(problem, fix or None) -> fix`` of a flat batch of problems; None for optloc's own stages.
    summary : str
        One line for listings.
    role : "start" or "refinement"
        Whether it needs no fix before it, or improves a fix.
    stage : callable, optional
        ``(problem, pool or None) -> pool``: replaces `solver` for optloc's own stages.
    batched : bool
        Whether it solves a batch at a time; other solvers go one by one. A study chooses the size of its chunks by
        this. Each chunk costs a file, and a stopped run loses the work on its last chunk.
    """

    solver: FixSolver | None
    summary: str
    role: str
    stage: Solver | None = None
    batched: bool = False

    @property
    def run(self) -> Solver:
        """Return the stage as a function of pools; a solver of fixes gets an adapter."""
        if self.stage is not None:
            return self.stage
        assert self.solver is not None
        return adapt(self.solver)


def _nlp(problem: Problem, pool: Pool | None) -> Pool:
    """Return the pool of `optloc.solvers.ipopt.nlp`."""
    from optloc.solvers.ipopt import nlp  # IPOPT is loaded on first use

    return nlp(problem, pool)


def compare_bounds(problem: Problem, pool: Pool | None) -> Pool:
    """Return a pool whose certificates compare costs with the lower bound of a relaxation: the stage "bound".

    The first formulation with a bound for the rows is used. Certificates of fixes that are already proven do not
    change.
    """
    if pool is None:
        raise InvalidProblem("bound needs a fix", "method", "put it after a refinement, as in 'gtrs+lsr+bound'")
    began, fix = perf_counter(), judge(problem, pool)
    for formulation in FORMULATIONS.values():
        found = None if formulation.bound is None else formulation.bound(problem, fix)
        if found is None or not np.isfinite(found.bound).any():
            continue
        tight, known = found.tight(fix.cost), np.flatnonzero(np.isfinite(found.bound)).tolist()
        proven = claims_before(pool)
        for i in known:
            before = fix.claims.proof[i]
            # a global proof stays; a proof over a region is replaced only by a tight bound
            if before != GLOBAL and (tight[i] or before != REGION):
                proven.write(i, _claim(float(fix.cost[i]), float(found.bound[i]), bool(tight[i]), found.method))
        stage = Stage("bound", f"{int(tight[known].sum())} of {len(tight)} proven", perf_counter() - began)
        return replace(pool, proven=proven, stages=(*pool.stages, stage))
    return pool


def _claim(cost: float, bound: float, tight: bool, name: str) -> Claims:
    """Return the claim from a lower bound of a relaxation; a tight bound is a global proof of the value.

    `cost` and `bound` are the cost of the fix and its lower bound, and `name` is the name of the relaxation.
    """
    reason = "no position has a lower chi-square" if tight else f"a lower bound leaves a gap of {cost - bound:.2g}"
    text = f"{reason}; other minima were searched for, not excluded"
    proof = "global" if tight else "local"
    return claim(Certificate(proof, text, f"{name.removesuffix('s')} relaxation", bound, cost - bound))


def _start(stage: Solver, summary: str, *, batched: bool = False) -> SolverEntry:
    """Return the table entry of a stage that needs no fix before it."""
    return SolverEntry(None, summary, "start", stage, batched)


def _refinement(stage: Solver, summary: str, *, batched: bool = False) -> SolverEntry:
    """Return the table entry of a stage that improves a fix."""
    return SolverEntry(None, summary, "refinement", stage, batched)


_STAGES: dict[str, SolverEntry] = {
    "gtrs": _start(stages.gtrs, "minimiser of the weighted squared-range problem: the cheapest start", batched=True),
    "roots": _start(stages.roots, "every stationary point of the squared-range problem", batched=True),
    "sdp": _start(stages.start_with("sdp"), "Shor's semidefinite relaxation of the squared-range problem (Clarabel)"),
    "socp": _start(stages.start_with("socp"), "second-order cone relaxation of the squared-range problem (Clarabel)"),
    "sparse": _start(sparse, "convex start for a few gross errors, and the fix without these rows (Clarabel)"),
    "wiv": _start(stages.start_with("wiv"), "pseudo-linear angles with an instrumental-variable pass", batched=True),
    "directions": _start(
        stages.start_with("directions"), "semidefinite relaxation over unit directions (Clarabel); angles"
    ),
    "minimax": _start(
        stages.start_with("minimax"), "smallest maximal angle by second-order cones (Clarabel); bounded errors"
    ),
    "add_candidates": _refinement(
        stages.add_candidates, "more candidates for a fix: mirror image, sub-arrays", batched=True
    ),
    "search": _refinement(
        stages.search,
        "a search for problems without an answer: over boxes if a proof bounds them, or from many positions",
        batched=True,
    ),
    "lsr": _refinement(stages.lsr, "damped Taylor least squares (Gauss-Newton) from every candidate", batched=True),
    "nlp": _refinement(_nlp, "the maximum-likelihood cost by IPOPT from every candidate"),
    "certify": _refinement(
        certified,
        "branch and bound: proves that no position has a lower chi-square, and that no other minimum comes near",
        batched=True,
    ),
    "value": _refinement(
        value_certified, "a faster proof for the cost alone, which does not exclude other minima", batched=True
    ),
    "bound": _refinement(compare_bounds, "compares the cost with the bound of a relaxation (Clarabel): angles, ranges"),
    "suspects": _refinement(
        suspect, "leaves out the stations, rows and priors that contradict the rest, and names them"
    ),
    "taylor": _refinement(
        stages.taylor, "plain Taylor iteration without damping: a baseline that often diverges", batched=True
    ),
}


class _Derived(dict[str, SolverEntry]):
    """Stages from other tables. A loss with a number in its name is made on demand."""

    def __missing__(self, name: str) -> SolverEntry:
        """Return the stage of a loss with a number in its name."""
        loss = LOSSES[name]
        return _start(Robust(loss, states=True), loss.summary)


def _derive() -> Mapping[str, SolverEntry]:
    """Return the stages that follow from other tables: one for each loss, and one for each start of a formulation."""
    out = _Derived({name: _start(Robust(loss, states=True), loss.summary) for name, loss in LOSSES.items()})
    for formulation in FORMULATIONS.values():
        for word in formulation.starts:
            out.setdefault(word, _start(stages.start_with(word), formulation.summary))
    return out


SOLVERS: Registry[SolverEntry] = Registry(
    "optloc.solvers", lambda value: isinstance(value, SolverEntry), _STAGES, _derive
)

# First stages of methods that a combined stage replaces, with the same result.
SHORTCUTS: Mapping[tuple[str, ...], PlannedStages] = {("gtrs", "lsr"): PlannedStages()}

# The method after "|" runs for problems that are not fully proven by then.
METHODS = {
    "auto": "gtrs+lsr+certify|roots+lsr+add_candidates+lsr+search+certify",
    "searched": "roots+lsr+add_candidates+lsr+search",
    "proven": "roots+lsr+add_candidates+lsr+search+certify+bound",
    "robust": "roots+lsr+add_candidates+lsr+search+suspects+certify",
}

# Names of stages in version 0.1 before its release: they work with a warning, so that scripts and studies still run.
_FORMER = {"widen": "add_candidates"}

# Endings of back ends that a sentence names: a longer list does not help.
_SHOWN = 3

# Statuses that more candidates do not change, so no proof is needed.
_SETTLED = (Status.REJECTED, Status.TOO_FEW_ROWS)


@dataclass(frozen=True, slots=True)
class Method:
    """A pipeline of stages, and a second pipeline for problems that the first does not prove.

    Parameters
    ----------
    words : tuple of str
        Names of the stages, keys of `SOLVERS`.
    then : Method, optional
        Method for the problems that are not fully proven; minima found before stay candidates.
    """

    words: tuple[str, ...]
    then: Method | None = None

    @classmethod
    def parse(cls, text: str) -> Method:
        """Return a method such as "auto" or "gtrs+lsr"; raise InvalidProblem naming an unknown word."""
        first, _, rest = METHODS.get(text, text).partition("|")
        words = tuple(_present_name(word) for word in first.split("+"))
        for word in words:
            if word not in SOLVERS:
                raise InvalidProblem(f"unknown method {word!r}", "method", nearest(word, [*METHODS, *SOLVERS]))
        return cls(words, cls.parse(rest) if rest else None)

    @property
    def branches(self) -> Iterator[Method]:
        """Yield the method and all methods that follow it."""
        method: Method | None = self
        while method is not None:
            yield method
            method = method.then

    @property
    def entries(self) -> list[SolverEntry]:
        """Return the table entries of the words of the method, from all branches."""
        return [SOLVERS[word] for branch in self.branches for word in branch.words]

    def runs(self, count: int) -> list[Solver]:
        """Return the stages of the first branch for `count` problems, with combined stages where available."""
        for words, short in SHORTCUTS.items():
            name = "+".join(words)
            if shortcut(self):
                return [_named(name, replace(short, alone=True))]
            if self.words[: len(words)] == words:
                return [_named(name, short), *map(_stage, self.words[len(words) :])]
        return [_stage(word) for word in self.words]

    def __call__(self, problem: Problem, pool: Pool | None = None) -> Pool:
        """Return the pool of a flat batch of problems.

        Three groups of problems take the last branch only. Problems beyond the scope of the proof have no proof. The
        proof of a run takes longer than all starts. Closed forms set an unknown factor of rows to one.
        """
        branches = list(self.branches)
        # the first branch would end without a proof, or with a proof that the last branch repeats
        if len(branches) > 1 and (why_unsupported(problem) or is_run(problem) or is_scaled(problem)):
            branches = branches[-1:]
        pool = _run_through(branches[0], problem, pool)
        for branch in branches[1:]:
            pool = _take_over(branch, problem, pool)
        return pool


def _present_name(word: str) -> str:
    """Return the present name of a stage, with a warning if it was renamed."""
    if word in _FORMER:
        new = _FORMER[word]
        warnings.warn(
            f"the stage {word} is {new} now; version 0.2 removes the old name", DeprecationWarning, stacklevel=4
        )
    return _FORMER.get(word, word)


def _stage(word: str) -> Solver:
    """Return the stage of a word; numerical failures report this word."""
    return _named(word, SOLVERS[word].run)


def _named(name: str, solver: Solver) -> Solver:
    """Return a stage that runs `solver`; its numerical failures report the name of the stage."""

    def stage(problem: Problem, pool: Pool | None) -> Pool:
        with noting_place(name), recording() as endings:
            found = solver(problem, pool)
        failed = [ending for ending in endings if not ending.found]
        return _note_failures(found, name, failed, len(endings)) if failed else found

    return stage


def _note_failures(pool: Pool, name: str, failed: list[Ending], solves: int) -> Pool:
    """Return the pool of a stage with the number of failed back-end runs, and their reports.

    `failed` has the failed runs, and `solves` is the number of all runs. Problems without a candidate get this reason.
    """
    reports = "; ".join(str(ending) for ending in list(dict.fromkeys(failed))[:_SHOWN])
    count = f"{len(failed)} of {solves} solve{'' if solves == 1 else 's'} without an answer"
    pool = pool.without(np.flatnonzero(pool.empty), f"{name}: {count} ({reports})", Status.NUMERICAL)
    if not pool.stages:
        return pool
    last = pool.stages[-1]
    return replace(pool, stages=(*pool.stages[:-1], replace(last, detail=f"{last.detail}; {count} ({reports})")))


def _run_through(method: Method, problem: Problem, given: Pool | None) -> Pool:
    """Return the pool after all stages of one branch; `given` candidates, or None, compete with its starts."""
    # a shortcut takes no starts
    first, *others = method.runs(problem.batch_shape[0]) if given is None else map(_stage, method.words)
    pool = first(problem, given)
    if given is not None and pool.curvature is None:
        # the given candidates compete with the starts of the stage
        pool = _with_starts(problem, pool, given.x)
    for stage in others:
        pool = stage(problem, pool)
    return pool


def _take_over(method: Method, problem: Problem, pool: Pool) -> Pool:
    """Return a pool whose unproven problems went through a further method.

    Candidates that were found before stay, so the answer cannot become worse.
    """
    fix = judge(problem, pool)
    items = np.flatnonzero(is_unproven(fix))
    if not len(items):
        return pool
    part, (first, *others) = problem.take(items), method.runs(len(items))
    start = first(part, None)
    # earlier candidates compete, so that a branch never gives a worse answer than the branch before
    new, before = (
        _with_starts(part, start, surviving_candidates(take(pool, items), fix[items])),
        tried_before(pool, fix, items),
    )
    for stage in others:
        # A proof takes most of the time, so it is not repeated if the other stages found no new minimum.
        new = stage(part, replace(new, tried_before=before))
    return replace(pool.merge(items, replace(new, tried_before=None)), stages=(*pool.stages, *new.stages))


def _with_starts(problem: Problem, start: Pool, x: Array) -> Pool:
    """Return a pool of starts with additional starts x (N, q, size)."""
    both = pack(np.concatenate([start.x, x], axis=1))
    return replace(offer(problem, both, None, "", perf_counter()), stages=start.stages, missing=start.missing)


def is_unproven(fix: Fix) -> Array:
    """Return flags (N,) of fixes that could still change: not every minimum within the listed gap of cost is known."""
    proven = (fix.claims.proof == GLOBAL) & (fix.claims.margin >= LISTED_GAP)
    return np.asarray(~proven & ~np.isin(fix.code, _SETTLED))


def shortcut(method: Method) -> bool:
    """Return whether one combined stage performs the whole method, so that a plan can replace the method."""
    return method.then is None and method.words in SHORTCUTS


def is_quick(problem: Problem, method: str) -> bool:
    """Return whether the first stages of a method have a plan; most fixes then take microseconds."""
    words = Method.parse(method).words
    return any(words[: len(planned)] == planned for planned in SHORTCUTS) and plan_of(problem) is not None
