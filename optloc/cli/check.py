"""The command ``optloc check``: summary of a file, health of its stations, and advice on possible errors.

In shapes, k is the number of epochs, s the number of stations, d the dimension, and size the number of unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from optloc.base.errors import InvalidProblem
from optloc.base.outputs import replace_together
from optloc.base.types import Array, Bias, Stations
from optloc.cli.file_fixes import table_json
from optloc.cli.fix import advice_for_vectors, advice_json, grouping_of, late_json, level_json, show_advice, tell_level
from optloc.cli.from_table import read_problem
from optloc.cli.output import (
    Screen,
    bar,
    claim_outputs,
    dumps,
    say_all,
    uses_standard_output,
    write_picture,
    write_table,
    write_text,
)
from optloc.files.reader import Loaded
from optloc.files.table_import import ColumnHints
from optloc.files.wave_speed import WaveOptions
from optloc.linear.redundancy import degrees_of_freedom, present_unknowns
from optloc.model_checks.cause import Advice
from optloc.model_checks.elements import By, batch_of
from optloc.model_checks.noise_level import CommonLevel, LateSignals, common_level_at, late_signals_at
from optloc.model_checks.plausibility import CHECKS
from optloc.models import MODELS
from optloc.partitions.epoch_fixes import fix_epochs
from optloc.problem.epoch_groups import explanations_by_epoch
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.answer_texts import with_sigma
from optloc.show.columns import Columns, records
from optloc.solvers.methods import Method
from optloc.station_health.stations import Health, health_of

# A bias with many members prints at most this number of names, so that the line stays readable.
_MEMBERS = 8


@dataclass(frozen=True, slots=True)
class CheckOptions:
    """Options of the station health check.

    solve: whether epochs are fixed at all. method: method of the fixes. by: grouping of the errors, "station", "pair"
    or "kind". out, plot: files for the table and the picture.
    """

    solve: bool = True
    method: str | None = None
    by: str = "station"
    out: Path | None = None
    plot: Path | None = None


def run_check(
    file: Path,
    as_json: bool,
    options: CheckOptions | None = None,
    *,
    quiet: bool = False,
    table: ColumnHints | WaveOptions | None = None,
) -> int:
    """Print a summary of a file and the health of its stations; return exit code 1 if an epoch has too few rows."""
    options = options or CheckOptions()
    # A file without measured values is valid here: you can check the geometry before a campaign.
    outputs = partial(claim_outputs, table=options.out, picture=options.plot, inputs=[file])
    outputs()  # check twice: before the reader spends time on a long table, and after it has recorded all input files
    on_output = uses_standard_output(options.out, as_json=as_json)
    loaded = read_problem(file, table, values=False, quiet=quiet or as_json, on_error=on_output)
    outputs()
    found = summary(loaded)
    checked = _health(loaded, options, quiet or as_json)
    advice = _advice(loaded, checked)
    if as_json:
        more: dict[str, Any] = {} if checked is None else {"health": _health_json(checked)}
        more |= {} if checked is None or checked.level is None else {"noise_level": level_json(checked.level)}
        more |= {} if checked is None or checked.late is None else {"late_signals": late_json(checked.late)}
        more |= {"warnings": list(loaded.warnings)} if loaded.warnings else {}
        write_text(Path("-"), dumps(found | table_json(loaded) | more | {"advice": advice_json(advice)}))
    elif not quiet:
        sheet = Table(title=loaded.title, show_header=False, title_justify="left")
        for name, value in found.items():
            sheet.add_row(name.replace("_", " "), _spell(value))
        screen = Screen(stderr=on_output)
        screen.print(sheet)
        if checked is not None:
            _show_health(checked, screen)
            say_all(screen, tell_level(checked.level, late=checked.late))
        show_advice(advice, screen)
    return 1 if found["epochs_with_too_few_rows"] else 0


def _health(loaded: Loaded, options: CheckOptions, quiet: bool) -> Checked | None:
    """Return the health of the stations of a file and write its table and picture; None with --no-solve."""
    if not options.solve:
        if options.out is not None or options.plot is not None:
            raise InvalidProblem(
                "table and picture need the fixes", "--no-solve", "remove it, or remove --out and --plot"
            )
        return None
    by = grouping_of(options.by, "--by")
    # Stations may be faulty here, so the default is a loss that reduces the weight of gross errors.
    method = options.method or "cauchy"
    Method.parse(method)  # reject a misspelt method before the work starts
    checked = _check_health(loaded, method, by, quiet)
    # If the user requests a table or picture that cannot be made, raise; the summary alone would only print the reason.
    for path, option in ((options.out, "--out"), (options.plot, "--plot")):
        if path is not None and checked.health is None:
            raise InvalidProblem(checked.why, option, "remove this option")
    if checked.health is not None:
        _write_health(checked.health, loaded.title, options)
    return checked


def _advice(loaded: Loaded, checked: Checked | None) -> tuple[Advice, ...]:
    """Return the advice from the geometry, and from the values as well if the epochs are solved."""
    vectors = None if checked is None else checked.vectors
    problem = loaded.problem if vectors is None else _with_noise(loaded.problem)
    if checked is None:
        # --no-solve only reads the file, so no advice comes from values
        problem = problem.with_rows(z=np.full_like(problem.z, np.nan))
    elif problem.epochs == 1 and np.isfinite(problem.z[problem.weight > 0.0]).all():
        from optloc.solvers.solution import solve

        vectors = solve(problem).x
    found = advice_for_vectors(problem, vectors)
    # The warnings of physical checks are printed before the summary.
    told = {check.name for check in CHECKS} if loaded.warnings else set()
    return tuple(one for one in found if one.cause not in told)


def _spell(value: Any) -> str:
    """Return a value of the summary as text."""
    if isinstance(value, dict):
        return ", ".join(f"{key}: {inner}" for key, inner in value.items()) or "none"
    if isinstance(value, list):
        return ", ".join(value) or "none"
    if isinstance(value, float):
        return f"{value:.4g}" if np.isfinite(value) else "unknown"
    return str(value)


def summary(loaded: Loaded) -> dict[str, Any]:
    """Return the summary of a file: names with numbers or words."""
    problem = loaded.problem
    alone = separable(problem)
    batch = _apart(problem, alone)
    redundancy = degrees_of_freedom(batch)
    parts = _components(problem)  # number of connected groups of stations in each epoch
    flattest, widest = _spread(_station_positions(problem, alone))
    # If epochs are fixed separately, report the epoch whose stations are closest to a line or plane.
    worst = int(np.argmin(flattest / widest))
    return {
        "file": loaded.source,
        "frame": problem.frame.kind,
        "dimension": problem.dimension,
        "stations": problem.stations.count,
        "moving_stations": _count_moving(problem.stations),
        "station_errors": _errors(problem),
        **({} if problem.medium is None else {"medium": problem.medium.words}),
        **({"wave_speed": loaded.speed} if loaded.speed and problem.medium is None else {}),
        "epochs": problem.epochs,
        "duration_s": float(np.ptp(loaded.times)),
        "targets": len(set(loaded.targets)),
        "rows": {block.kind: block.count for block in problem.rows},
        "absent_rows": int((problem.weight == 0.0).sum()),
        "constraints": [limit.name for limit in (*problem.constraints, *problem.fences)],
        "biases": {bias.name: _bias(loaded, bias) for bias in problem.biases},
        "unknowns": int(present_unknowns(batch).max()),
        "redundancy": {"least": int(redundancy.min()), "median": float(np.median(redundancy))},
        "epochs_with_too_few_rows": int((redundancy < 0).sum()),
        "groups_of_connected_stations": {"most": int(parts.max(initial=0))},
        "epochs_with_disconnected_pairs": int((parts > 1).sum()),
        "geometry": f"stations spread {flattest[worst]:.4g} m (root mean square) across, {widest[worst]:.4g} m along",
        **({"azimuths": loaded.azimuths} if loaded.azimuths else {}),
    }


def _count_moving(stations: Stations) -> int:
    """Return the number of stations that have a velocity, or whose position changes between epochs."""
    moving = np.ptp(stations.position, axis=0).max(-1) > 0.0
    return int((moving if stations.velocity is None else moving | stations.velocity.any((0, -1))).sum())


def _errors(problem: Problem) -> str:
    """Return a text with the standard deviations of station positions and velocities, and the span of these errors."""
    sizes, span = [], problem.stations.unknown_for
    for _, unit, covariance in problem.stations.errors:
        sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
        low, high = sigma.min(), sigma.max()
        sizes.append(f"{low:.4g} {unit}" if low == high else f"{low:.4g} to {high:.4g} {unit}")
    duration = f"unknown for each {span}" if span else "noise of each epoch"
    return f"{' and '.join(sizes)}, {duration}" if sizes else "none"


def _bias(loaded: Loaded, bias: Bias) -> str:
    """Return a text with the form, members and prior of a bias."""
    slot, _ = loaded.problem.layout.find(bias.name)
    unit, size = loaded.bias_unit(bias.name, slot.unit)
    names = ", ".join(bias.members[:_MEMBERS]) + (
        f" and {len(bias.members) - _MEMBERS} more" if len(bias.members) > _MEMBERS else ""
    )
    if bias.density is not None:
        # the drift after one second is easier to judge than a spectral density
        # column 0 of `density` is the density of the value, a further column the density of its rate
        ends = np.sqrt([bias.density[:, 0].min(), bias.density[:, 0].max()])
        drift = " to ".join(dict.fromkeys(f"{v:.3g}" for v in ends))
        names += f", {drift} {slot.unit} after a second" + (", rates walk too" if bias.density.shape[1] > 1 else "")
    if bias.sigma is None:
        return f"{bias.form} of {names}, unknown"
    low, high = np.min(bias.sigma) / abs(size), np.max(bias.sigma) / abs(size)
    prior = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
    return f"{bias.form} of {names}, prior {prior} {unit}"


def _apart(problem: Problem, alone: bool) -> Problem:
    """Return the epochs as a batch if they are fixed separately (`alone`), else the run as a batch of one."""
    return (by_epoch(problem) if alone else problem).flat()


def _components(problem: Problem) -> Array:
    """Return the number of connected groups of stations in each epoch (k,); 0 without differences.

    Differences and ratios connect the two stations of a row. The rows A-B and C-D give two groups, for instance.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    s, k = problem.stations.count, problem.epochs
    ends = []
    for block in problem.rows:
        ranges = MODELS[block.kind].ranges
        # Differences and ratios connect two stations; ranges, angles and sums of ranges do not.
        if MODELS[block.kind].stations == 2 and (ranges is None or sum(ranges) == 0):
            present = block.weight > 0.0
            # One graph holds all epochs: its vertex with the number e s + i is station i in epoch e.
            ends.append(np.stack([block.epoch * s + block.a, block.epoch * s + block.b])[:, present])
    edges = np.concatenate(ends, axis=-1) if ends else np.zeros((2, 0), dtype=int)
    graph = coo_array((np.ones(edges.shape[1]), (edges[0], edges[1])), shape=(k * s, k * s))
    _, label = connected_components(graph, directed=False)
    touched = np.unique(edges)
    # distinct pairs of an epoch and a connected group in it
    pairs = np.unique(np.stack([touched // s, label[touched]]), axis=1)
    return np.bincount(pairs[0], minlength=k)


def _station_positions(problem: Problem, alone: bool) -> Array:
    """Return the station positions, m: of each epoch (k, s, d), or of all epochs of a run together (1, k s, d).

    `alone` is whether the epochs are fixed separately.
    """
    position = problem.stations.position
    return position if alone else position.reshape(1, -1, position.shape[-1])


def _spread(position: Array) -> tuple[Array, Array]:
    """Return the smallest and the largest root mean square extent (k,) of stations (k, s, d) about their centre, m."""
    centred = position - position.mean(-2, keepdims=True)
    values = np.linalg.svd(centred, compute_uv=False) / np.sqrt(position.shape[-2])
    # Too few stations to span the space have zero extent in the last direction.
    if position.shape[-2] <= position.shape[-1]:
        values = np.concatenate([values, np.zeros((*values.shape[:-1], 1))], axis=-1)
    return values[..., -1], np.maximum(values[..., 0], np.finfo(float).tiny)


# Station health.


@dataclass(frozen=True, slots=True)
class Checked:
    """Result of the health check.

    health: health of the stations, or None. why: reason for None. vectors: parameters of the epochs (k, size), NaN for
    an epoch without a fix; None if the epochs are not solved. level: common factor of the noise, or None. late: late
    rows, or None.
    """

    health: Health | None
    why: str = ""
    vectors: Array | None = None
    level: CommonLevel | None = None
    late: LateSignals | None = None


def _check_health(loaded: Loaded, method: str, by: By, quiet: bool) -> Checked:
    """Return the health of the stations of a file, or the reason for which it cannot be computed.

    Each epoch is fixed separately by `method`, and `by` groups the errors. Raise InvalidProblem for a wrong option.
    """
    problem = loaded.problem
    if problem.epochs < 2:
        return Checked(
            None, "station health needs several epochs, and the file has one; add epochs to test the stations"
        )
    # Epochs of a calibration share no unknowns, though the known track makes their problem inseparable.
    calibrating = all(motion.known is not None for motion in problem.motions)
    if not separable(problem) and not (calibrating and not problem.biases):
        return Checked(None, "station health needs separate epochs; the epochs of this file share unknowns")
    if not np.isfinite(problem.z[problem.weight > 0.0]).all():
        return Checked(None, "station health needs measured values")
    try:
        return _solve_health(loaded, method, by, quiet)
    except InvalidProblem as error:
        # A misspelt option is an error of the user; insufficient data is a normal result with a reason.
        if error.where in ("by", "method"):
            raise
        return Checked(None, f"station health could not be computed: {error.what}; {error.advice}")


def _solve_health(loaded: Loaded, method: str, by: By, quiet: bool) -> Checked:
    """Return the health of the stations from a fix of each epoch.

    `method` is the method of the fixes, and `by` groups the errors. Raise InvalidProblem if no epoch has a fix.
    """
    batch, alone = batch_of(loaded.problem), separable(loaded.problem)
    # Without unknowns (known targets, no biases), there is nothing to fix: parameter vectors are empty.
    if not batch.layout.size:
        count = batch.batch_shape[0]
        return Checked(health_of(batch, (np.arange(count), np.zeros((count, 0))), by))
    fix = _fix(loaded, batch, method, quiet)
    # Fixes without an answer are set to NaN and left out.
    vectors = np.where(fix.answered[:, None], fix.x, np.nan)
    kept = np.flatnonzero(np.isfinite(vectors).all(-1))
    if not len(kept):
        raise InvalidProblem("no epoch has a fix", loaded.source, "see `optloc fix` for the reasons")
    health = health_of(batch, (kept, vectors[kept]), by, fix.explanations)
    level = common_level_at(batch.take(kept), vectors[kept])
    late = late_signals_at(batch, kept, vectors[kept])
    return Checked(health, vectors=vectors if alone else None, level=level, late=late)


def _fix(loaded: Loaded, batch: Problem, method: str, quiet: bool) -> Fix:
    """Return the fixes of the epochs. Station errors count as noise, and rows are numbered as in the batch."""
    problem = _with_noise(loaded.problem)
    if not separable(problem):
        from optloc.solvers import solve

        return solve(batch, method)
    with bar(loaded.title, problem.epochs, quiet) as advance:
        fix, _ = fix_epochs(replace(loaded, problem=problem), method, advance)
    if fix.explanations is None:
        return fix
    return replace(fix, explanations=explanations_by_epoch(problem, fix.explanations))


def _with_noise(problem: Problem) -> Problem:
    """Return the problem with station errors as noise of each epoch, since the health check does not estimate them."""
    return replace(problem, stations=problem.stations.with_noise())


def _health_columns(health: Health) -> Columns:
    """Return the health table: one row for each group, SI units and radians, NaN for missing numbers."""
    return {
        "name": np.array(health.names, dtype=object),
        "unit": np.array(health.units, dtype=object),
        "count": health.count,
        "bias": health.bias,
        "bias_error": health.bias_error,
        "scale": health.scale,
        "scale_error": health.scale_error,
        "noise": health.noise,
        "noise_error": health.noise_error,
        "outliers": health.outliers,
        "least_noticed": health.least_noticed,
        "suspect": health.suspect,
    }


def _health_json(checked: Checked) -> dict[str, Any]:
    """Return the health of the stations as a JSON value."""
    if checked.health is None:
        return {"stations": [], "sentences": [checked.why]}
    levels = checked.health.levels
    noise = {"by": levels.by, "fixes": levels.fixes, "chi_square_stated": levels.before, "chi_square": levels.after}
    return {
        "stations": records(_health_columns(checked.health)),
        "noise": noise,
        "sentences": list(checked.health.sentences),
    }


def _show_health(checked: Checked, console: Console) -> None:
    """Print the health of the stations as a table, sorted by decreasing bias."""
    health = checked.health
    if health is None:
        say_all(console, [checked.why])
        return
    # Leave out columns without any number.
    scaled, suspected = np.isfinite(health.scale).any(), np.isfinite(health.suspect).any()
    table = Table(title=f"Health by {health.by}", title_justify="left")
    table.add_column(health.by)
    wanted = ["fixes", "bias", *(["scale, ppm"] if scaled else []), "noise", "outliers", "detectable from"]
    for name in [*wanted, *(["suspect"] if suspected else [])]:
        table.add_column(name, justify="right")
    seen = health.least_noticed
    for i in _order(health):
        cells = [str(health.count[i]), _with_sigma_or_dash(health.bias[i], health.bias_error[i], health.units[i])]
        cells += [_with_sigma_or_dash(1e6 * health.scale[i], 1e6 * health.scale_error[i], "")] if scaled else []
        cells += [
            _with_sigma_or_dash(health.noise[i], health.noise_error[i], health.units[i]),
            f"{health.outliers[i]:.1%}",
        ]
        cells += [f"{seen[i]:.3g} {health.units[i]}".strip()]
        cells += [f"{health.suspect[i]:.1%}"] if suspected else []
        table.add_row(health.names[i], *cells)
    console.print(table)
    levels = health.levels
    chi = f"chi-square per degree of freedom: {levels.before:.3g} as stated, {levels.after:.3g} as estimated"
    what = "bias and noise refer to measurements minus their predictions from the other stations"
    say_all(console, (f"{levels.fixes} fixes; {what}; {chi}", *health.sentences))


def _order(health: Health) -> Array:
    """Return the order of the groups of the health table (n,): by unit, then by decreasing bias."""
    bias = np.where(np.isfinite(health.bias), health.bias, np.inf)
    # Only biases with the same unit can be compared.
    return np.lexsort((-bias, np.array(health.units)))


def _with_sigma_or_dash(value: float, error: float, unit: str) -> str:
    """Return a value with its standard deviation `error` and unit as text; "-" for a missing value."""
    if not np.isfinite(value):
        return "-"
    return with_sigma(float(value), float(error), unit).strip()


def _write_health(health: Health, title: str, options: CheckOptions) -> None:
    """Write the requested table and picture of the health: both, or none if one fails."""
    with replace_together():
        if options.out is not None:
            write_table(options.out, _health_columns(health))
        if options.plot is not None:
            from optloc.show.pictures.residuals import plot_health

            write_picture(plot_health(health, title=title), options.plot)
