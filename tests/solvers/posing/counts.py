"""Counts of posed problems: one record per problem, kept on disk, and the row of a table for each formulation."""

import json
from time import monotonic

import numpy as np
from solvers.posing.measures import ISOLATED, LEAST, WITHOUT_POSITION, above_least, denied_points, drawn, fenced

from optloc import InvalidProblem, pose

# Limits of residuals and of duals, and of bounds above an independent search.
KKT, DUAL, ABOVE = 1e-6, 1e-4, 1e-6
HEADER = [
    "formulation",
    "problems",
    "worst residual or gap",
    "above 1e-6",
    "duals",
    "at a kink",
    "worst error of a dual",
    "above 1e-4",
    "no point exists",
    "denied points",
    "bounds",
    "above an independent search",
]


def record(formulation, seed):
    """Return the measures of one problem as a dictionary of plain numbers; a refusal has no residual."""
    try:
        return measures(formulation, seed)
    except InvalidProblem:
        return {"seed": seed, "outcome": "refused", "worst": float("nan")}


def measures(formulation, seed):
    """Return the measures of one problem that is posed; see `record`."""
    if formulation in WITHOUT_POSITION:
        posed = pose(drawn(formulation, seed), formulation)
        base, unit = posed.solve(refine=False).posed, posed.unit
        out = {"seed": seed, "outcome": "without position", "worst": base.backend.worst}
    else:
        found = fenced(formulation, seed)
        base, unit = found.base, found.unit
        out = {"seed": seed, "outcome": found.outcome, "worst": found.worst}
        if found.outcome in ("no point", "infeasible"):
            # only rows that fit at isolated points may have no solution beside the optimum
            isolated = formulation in ISOLATED
            out["denied"] = denied_points(formulation, seed, fence=found.outcome != "no point") if isolated else 1
        elif found.outcome != "failed":
            out |= {"error": found.error, "smooth": found.smooth}
    if formulation in LEAST and out["outcome"] not in ("no point", "failed"):
        out["above"] = above_least(formulation, seed, base, unit)
    return out


def counted(formulation, seeds, folder, seconds=np.inf):
    """Return the records of seeds, from a file in a folder where it has them; stop after some seconds."""
    file, begun = folder / f"{formulation.replace(': ', '-')}.jsonl", monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    known = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    made = {one["seed"]: one for one in known}
    for seed in seeds:
        if seed in made:
            continue
        if monotonic() - begun > seconds:
            break
        made[seed] = record(formulation, seed)
        with file.open("a") as lines:
            lines.write(json.dumps(made[seed]) + "\n")
    return [made[seed] for seed in seeds if seed in made]


def failures(records):
    """Return the records that miss a limit."""
    return [
        one
        for one in records
        if not one["worst"] <= KKT
        or not one.get("error", 0.0) <= DUAL
        or one.get("denied", 0)
        or not one.get("above", 0.0) <= ABOVE
    ]


def row(records):
    """Return the cells of a formulation after its name."""
    worst = np.array([one["worst"] for one in records])
    error = np.array([one["error"] for one in records if "error" in one])
    above = np.array([one["above"] for one in records if "above" in one])
    kinks = sum(not one.get("smooth", True) for one in records)
    denied = [one["denied"] for one in records if "denied" in one]
    return [
        len(records),
        f"{np.nanmax(worst):.0e}",
        int((~(worst <= KKT)).sum()),
        len(error),
        kinks if len(error) else "",
        f"{error.max():.0e}" if len(error) else "",
        int((~(error <= DUAL)).sum()) if len(error) else "",
        len(denied),
        sum(denied),
        len(above) or "",
        int((~(above <= ABOVE)).sum()) if len(above) else "",
    ]
