"""``optloc study``: run, status, report, compare."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from itertools import groupby
from math import isinf, isnan, nan
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from optloc.cli import (
    STOPPED,
    Budget,
    CommandGroup,
    Force,
    Json,
    Outside,
    Quiet,
    Screen,
    Verbose,
    complete,
    example,
    find_problem,
    show_sheet,
)
from optloc.files import claim
from optloc.problem import InvalidProblem
from optloc.show import FixSheet

# Heavy libraries are imported inside the commands, so that --help replies at once.

# Least difference of two shares of answers that is reported, in standard deviations. By chance 3 in 1000 exceed it.
_DIFFERS = 3.0

# Each process takes about 200 MB. A larger number is a typing error.
_MOST_JOBS = 1024

study = typer.Typer(
    cls=CommandGroup,
    rich_markup_mode="rich",
    epilog=example("optloc list studies", "optloc study run divergence --out divergence"),
    help="Compare methods and solvers over scenarios, noise levels and many trials.",
)

Plugins = Annotated[
    list[str] | None,
    typer.Option("--plugin", metavar="FILE.py", help="Run a Python file or module first, as optloc --plugin does."),
]
Methods = Annotated[
    list[str] | None,
    typer.Option(
        "--method", "-m", metavar="NAME", help="One more method: its name, or FILE.py:FUNCTION or MODULE:FUNCTION."
    ),
]
Jobs = Annotated[
    int | None, typer.Option("--jobs", "-j", min=1, max=_MOST_JOBS, help="Processes; all processors by default.")
]
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Output folder of a study.")]


@study.command(
    epilog=example(
        "optloc study run divergence --out divergence",
        "optloc study run my.toml --out runs/my --trials 10000",
        "optloc study run my.toml --out runs/my --method mine.py:simplex",
        "optloc study run my.toml --out runs/my --executor dask --scheduler tcp://10.0.0.1:8786",
    )
)
def run(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", autocompletion=complete("studies"), help="Study file, or the name of a shipped study."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Output folder; NAME-study by default. A stopped run continues.")
    ] = None,
    executor: Annotated[
        str, typer.Option("--executor", "-x", metavar="NAME", help="processes, dask or ray.")
    ] = "processes",
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Running cluster, such as tcp://host:8786; implies dask.")
    ] = None,
    jobs: Jobs = None,
    limit: Annotated[
        float, typer.Option("--task-limit", metavar="SECONDS", help="Time limit of a task, as a method may hang.")
    ] = 600.0,
    trials: Annotated[int | None, typer.Option(min=1, help="Number of trials, instead of the file's.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed, instead of the file's.")] = None,
    methods: Methods = None,
    plugin: Plugins = None,
    outside: Outside = False,
    budget: Budget = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run a study, or continue a stopped one: finished parts are kept, and only new methods run."""
    from optloc.lab.study.design import design_of
    from optloc.lab.study.execute import executor as chosen, run_design
    from optloc.lab.study.methods import added
    from optloc.problem import load_plugin

    for name in plugin or ():
        load_plugin(name)
    # Only dask has a scheduler.
    by = chosen("dask" if scheduler is not None and executor == "processes" else executor, jobs, scheduler, limit)
    design = design_of(file, trials=trials, seed=seed, more=added(methods or ()))
    folder = Path(f"{design.study.name}-study".replace(" ", "-").replace("/", "-")) if out is None else out
    try:
        with _bar(design.study.name, design.rows, quiet or as_json) as tell:
            found = run_design(design, folder, by, tell, lambda line: typer.echo(line, err=True))
    # Not an error: finished parts are already on disk.
    except KeyboardInterrupt:
        typer.echo(f"Stopped. Finished parts are in {folder}; run the same command to continue.", err=True)
        raise typer.Exit(STOPPED) from None
    if as_json:
        _print_json(_record(found))
    elif not quiet:
        _show(found, Screen())
        _say(f"The table is in {folder}; optloc study report {folder} makes the report.")


@study.command(epilog=example("optloc study status runs/my"))
def status(folder: Folder, as_json: Json = False, quiet: Quiet = False, verbose: Verbose = False) -> None:
    """Print the progress of a study and the statuses of its methods. Exit code 1 while the study is not finished."""
    from optloc.lab.study.folder import progress

    found = progress(folder)
    if as_json:
        _print_json(_record(found))
    elif not quiet:
        _show(found, Screen())
    raise typer.Exit(0 if found.complete else 1)


@study.command(epilog=example("optloc study report runs/my", "optloc study report runs/my --out paper"))
def report(
    folder: Folder,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the report; report in the study's folder by default.")
    ] = None,
    outside: Outside = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Make one HTML page of a study, and its tables (CSV, LaTeX) and figures (PNG, SVG) as files.

    For a study that is not finished, the report covers the finished parts.
    """
    from optloc.lab.report.study_page import write_report

    console = Screen(stderr=True)
    shown = console.shows_bars and not quiet
    with console.status("report") if shown else nullcontext() as status:
        files = write_report(folder, out, (lambda text: status.update(f"report: {text}")) if status else None)
    if not quiet:
        _say(f"{files[0]} is the report; {len(files) - 1} tables and figures are in the same folder.")


@study.command(epilog=example("optloc study compare runs/before runs/after"))
def compare(
    one: Annotated[Path, typer.Argument(metavar="A", help="Output folder of the first study.")],
    two: Annotated[Path, typer.Argument(metavar="B", help="Output folder of the second study.")],
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Compare two studies cell by cell. Exit code 1 if a share of answers differs by more than 3 sigma."""
    from dataclasses import asdict

    from optloc.lab.study.summary import compared

    found = compared(one, two)
    if as_json:
        _print_json([asdict(difference) for difference in found])
    elif not quiet:
        _show_comparison(found, one, two, Screen())
    raise typer.Exit(int(any(abs(difference.z) > _DIFFERS for difference in found)))


@study.command(
    epilog=example("optloc study bench", "optloc study bench --method mine.py:simplex --page leaderboard.md")
)
def bench(
    methods: Methods = None,
    plugin: Plugins = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Output folder; only new methods run.")] = Path(
        "bench-study"
    ),
    page: Annotated[
        Path | None, typer.Option(metavar="OUT.md", help="File of the leaderboard; standard output by default.")
    ] = None,
    jobs: Jobs = None,
    trials: Annotated[int | None, typer.Option(min=1, help="Fewer trials, for a test; the data differ.")] = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Solve the public test set by a few methods and yours, and write a leaderboard of right answers as a page."""
    from optloc.cli import write_text
    from optloc.lab.study.design import design_of
    from optloc.lab.study.execute import executor, run_design
    from optloc.lab.study.leaderboard import SET, page as made
    from optloc.lab.study.methods import added
    from optloc.problem import load_plugin

    claim(page)
    for name in plugin or ():
        load_plugin(name)
    design = design_of(Path(SET), trials=trials, more=added(methods or ()))
    with _bar(design.study.name, design.rows, quiet) as tell:
        run_design(design, out, executor("processes", jobs), tell, lambda line: typer.echo(line, err=True))
    if page is not None or not quiet:
        write_text(Path("-") if page is None else page, made(out, design))


@study.command(epilog=example("optloc study pairs runs/my --against auto"))
def pairs(
    folder: Folder,
    against: Annotated[
        str | None, typer.Option(metavar="METHOD", help="Method to compare with; the first of the study by default.")
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Compare methods trial by trial: answers that only one gets right, differences of errors and of times."""
    from dataclasses import asdict

    from optloc.lab.study.folder import read_frame, read_manifest
    from optloc.lab.study.paired import paired
    from optloc.lab.study.summary import COLUMNS, judged

    first = next(iter(read_manifest(folder).methods.values()), "")
    found = paired(judged(read_frame(folder, COLUMNS)), first if against is None else against)
    if as_json:
        _print_json([asdict(one) for one in found])
    elif not quiet:
        _show_pairs(found, Screen())


@study.command(
    epilog=example(
        "optloc study profiles runs/my",
        "optloc study profiles runs/my --work evaluations --tau 0.01 --plot profiles.svg",
    )
)
def profiles(
    folder: Folder,
    tau: Annotated[
        float, typer.Option(metavar="COST", help="A trial is solved at this cost above the least known, or less.")
    ] = 1e-3,
    work: Annotated[
        str, typer.Option(metavar="NAME", help="processor (time) or evaluations (of the cost).")
    ] = "processor",
    plot: Annotated[
        Path | None, typer.Option(metavar="OUT", help="Picture of both profiles: .png, .svg or .pdf.")
    ] = None,
    outside: Outside = False,
    as_json: Json = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Print data and performance profiles: the share of trials that each method solves within a given work."""
    from optloc.cli import claim_outputs, write_picture
    from optloc.lab.study import summary
    from optloc.lab.study.folder import read_frame, read_manifest, references
    from optloc.lab.study.problem_copies import design_of_manifest
    from optloc.lab.study.profiles import profiles as profiled

    claim_outputs(picture=plot)
    frame = read_frame(folder, summary.COLUMNS)
    if not len(frame):
        raise InvalidProblem("the study has no finished part yet", str(folder), "run the study")
    known = references(design_of_manifest(read_manifest(folder), folder))
    found = profiled(frame, tau=tau, work=work, out=known)
    if plot is not None:
        from optloc.lab.report.figures import profile_picture
        from optloc.show import marks

        write_picture(profile_picture(found, marks(list(found.methods))), plot)
    if as_json:
        _print_json(_profile_record(found))
    elif not quiet:
        _show_profiles(found, Screen())


@study.command(
    epilog=example(
        "optloc study histories runs/my --plot down.png --out down.csv",
        "optloc study histories runs/my --method mine.py:simplex --case outside --noise '10 m'",
        "optloc study histories site.toml --method gauss-newton --method mine.py:simplex --plot down.png",
    )
)
def histories(
    place: Annotated[
        Path,
        typer.Argument(
            metavar="WHERE",
            help="Output folder of a study, a problem file, or the name of a shipped problem.",
            callback=find_problem,
        ),
    ],
    methods: Methods = None,
    plugin: Plugins = None,
    trials: Annotated[int, typer.Option(min=1, help="Most trials, or epochs of a file, from the first on.")] = 20,
    case: Annotated[str | None, typer.Option(metavar="LABEL", help="Case of a study; the first by default.")] = None,
    noise: Annotated[
        str | None, typer.Option(metavar="LABEL", help="Noise level of a study; the first by default.")
    ] = None,
    tau: Annotated[
        float, typer.Option(metavar="COST", help="The minimum is reached at this cost above the least known.")
    ] = 1e-3,
    out: Annotated[Path | None, typer.Option(metavar="OUT", help="Table of all points: .csv or .parquet.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="OUT", help="Picture: .png, .svg or .pdf.")] = None,
    outside: Outside = False,
    as_json: Json = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Record how methods descend: the cost against evaluations of the cost and against iterations."""
    from optloc.cli import claim_outputs, write_picture, write_table
    from optloc.lab.study.histories import histories as followed, reach, trials_of
    from optloc.problem import load_plugin

    claim_outputs(table=out, picture=plot, inputs=[] if place.is_dir() else [place])
    for name in plugin or ():
        load_plugin(name)
    found = followed(trials_of(place, methods or (), trials, case, noise))
    reached = reach(found, tau)
    if out is not None:
        write_table(out, {str(name): column.to_numpy() for name, column in found.frame.items()})
    if plot is not None:
        from optloc.lab.report.figures import history_picture
        from optloc.show import marks

        write_picture(history_picture(found, marks(list(found.methods))), plot)
    if as_json:
        from dataclasses import asdict

        ways = [asdict(one) for one in reached]
        _print_json({"title": found.title, "tau": tau, "methods": ways, "remarks": list(found.remarks)})
    elif not quiet:
        _show_histories(found, reached, tau, Screen())


@study.command(epilog=example("optloc study schema > study.schema.json"))
def schema(verbose: Verbose = False) -> None:
    """Print the JSON schema of study files."""
    from optloc.lab.study.document import study_schema

    _print_json(study_schema())


def _print_json(value: Any) -> None:
    """Print a value as JSON on standard output."""
    from optloc.cli import dumps

    typer.echo(dumps(value))


def _say(line: str) -> None:
    """Print a line for people."""
    from optloc.cli import say

    say(Screen(), line)


def _record(state: Any) -> dict[str, Any]:
    """Return the progress of a study (`Progress`) as a dictionary for JSON."""
    manifest = state.manifest
    return {
        "name": manifest.name,
        "title": manifest.title,
        "seed": manifest.seed,
        "version": manifest.version,
        "created": manifest.created,
        "machine": manifest.machine,
        "versions": manifest.versions,
        "complete": state.complete,
        "chunks": state.done,
        "chunks_planned": state.chunks,
        "rows": state.rows,
        "rows_planned": manifest.rows,
        "statuses": state.counts,
        "methods": [
            {"method": method, "status": status, "rows": count, "reason": state.failures.get((method, status), "")}
            for (method, status), count in state.methods.items()
        ],
    }


@contextmanager
def _bar(title: str, total: int, quiet: bool) -> Iterator[Any]:
    """Yield a function that advances a progress bar by rows, and updates its counts of statuses.

    `total` is the number of all rows. Only terminals show the bar.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Screen(stderr=True)
    counts: Counter[str] = Counter()
    parts = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    shown = console.shows_bars and not quiet
    with Progress(*parts, TextColumn("{task.fields[counts]}"), console=console, disable=not shown) as progress:
        task = progress.add_task(title, total=total, counts="")

        def tell(rows: int, more: dict[str, int]) -> None:
            counts.update(more)
            progress.update(task, advance=rows, counts=_in_words(counts))

        yield tell


def _in_words(counts: Counter[str], most: int = 3) -> str:
    """Return the most frequent statuses with their counts as text; the counts of the others are added."""
    first = [f"{status} {count}" for status, count in counts.most_common(most)]
    rest = counts.total() - sum(count for _, count in counts.most_common(most))
    return ", ".join([*first, *([f"other {rest}"] if rest else [])])


def _show(progress: Any, console: Console) -> None:
    """Print the progress of a study: a table of statuses by method, and the reasons of failures."""
    manifest = progress.manifest
    state = "complete" if progress.complete else f"{progress.done} of {progress.chunks} chunks"
    line = f"{manifest.title or manifest.name}: {state}, {progress.rows} of {manifest.rows} rows"
    console.print(line, style="bold", highlight=False, markup=False, soft_wrap=True)
    show_sheet(_status_sheet(progress, console.width), console)
    for (method, name), reason in progress.failures.items():
        line = f"{method}: {name} in {progress.methods[method, name]} trials, for example: {reason}"
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _status_sheet(progress: Any, width: int) -> FixSheet:
    """Return the table of statuses by method.

    Each status is a column if the table fits in `width` characters; otherwise each status of a method is a row.
    """
    statuses = [status for status, _ in Counter(progress.counts).most_common()]
    methods = list(dict.fromkeys(method for method, _ in progress.methods))
    # A column is as wide as the longest word of its heading, with two blanks and a line.
    words = [max(map(len, name.split())) for name in statuses]
    if max(map(len, methods), default=0) + 4 + sum(word + 3 for word in words) <= width:
        cells = [(name, *(str(progress.methods.get((name, one), 0)) for one in statuses)) for name in methods]
        return FixSheet("", ("method", *statuses), cells)
    rows: list[tuple[str, ...]] = []
    ends = []
    for name in methods:
        found = [(one, progress.methods[name, one]) for one in statuses if (name, one) in progress.methods]
        rows += [(name if i == 0 else "", one, str(count)) for i, (one, count) in enumerate(found)]
        ends.append(len(rows) - 1)
    return FixSheet("", ("method", "status", "trials"), rows, tuple(ends))


def _show_comparison(differences: list[Any], one: Path, two: Path, console: Console) -> None:
    """Print a table for each case and noise level with both studies; `differences` are from `summary.compared`."""
    console.print(f"A = {one}, B = {two}", highlight=False, markup=False, soft_wrap=True)
    for case, group in groupby(differences, lambda difference: difference.cell[:3]):
        scenario, sweep, noise = case
        title = " ".join([scenario, *([] if sweep == "{}" else [sweep]), noise])
        console.print(title, style="bold", highlight=False, markup=False, soft_wrap=True)
        rows = []
        for difference in group:
            values = "identical" if difference.identical else "same data" if difference.same_data else "other data"
            times = difference.two.seconds / difference.one.seconds if difference.one.seconds else nan
            numbers = (
                100 * difference.one.answered,
                100 * difference.two.answered,
                difference.z,
                difference.one.rmse,
                difference.two.rmse,
                times,
            )
            rows.append((difference.cell[3], *("-" if isnan(n) else f"{n:.4g}" for n in numbers), values))
        heads = ("answers A, %", "answers B, %", "z", "RMSE A, m", "RMSE B, m", "time B/A", "values")
        show_sheet(FixSheet("", ("method", *heads), rows), console)


def _show_pairs(pairs: list[Any], console: Console) -> None:
    """Print a table for each case and noise level with the paired comparisons of methods."""
    for (case, noise), group in groupby(pairs, lambda pair: (pair.case, pair.noise)):
        rows = list(group)
        title = f"{case}, {noise}: against {rows[0].against}"
        console.print(title, style="bold", highlight=False, markup=False, soft_wrap=True)
        heads = ("trials", "only it : only other right", "p", "error difference, m", "time ratio")
        table = []
        for pair in rows:
            # The interval is below the median: side by side, two of them do not fit in 80 characters.
            medians = (
                "-" if isnan(one.value) else f"{one.value:.2g}\n[{one.low:.2g}, {one.high:.2g}]"
                for one in (pair.error, pair.time)
            )
            only = f"{pair.alone} : {pair.other_alone}"
            table.append((pair.method, str(pair.trials), only, f"{pair.p:.2g}", *medians))
        show_sheet(FixSheet("", ("method", *heads), table), console)
    console.print("In brackets: 95 % interval of the median.", highlight=False, markup=False)


def _profile_record(profile: Any) -> dict[str, Any]:
    """Return data and performance profiles (`Profiles`) as a dictionary for JSON."""
    from dataclasses import asdict

    from optloc.lab.study.profiles import RATIOS, shares

    budgets = profile.budgets
    return {
        "tau": profile.tau,
        "work": profile.work,
        "trials": profile.spent.shape[1],
        "trials_of_the_study": profile.total,
        "not_told": list(profile.silent),
        "ratios": list(RATIOS),
        "budgets": budgets,
        "methods": [
            asdict(share) | {"within": list(share.within.values()), "data_profile": curve}
            for share, curve in zip(shares(profile), profile.data(budgets), strict=True)
        ],
    }


def _show_profiles(profile: Any, console: Console) -> None:
    """Print the shares of trials that each method solves within multiples of the least work."""
    from optloc.lab.report.sheets import duration, number, percent, solved_within
    from optloc.lab.study.profiles import RATIOS, shares

    shown = duration if profile.work == "processor" else number
    rows = []
    for share in shares(profile):
        within = (percent(share.within[ratio]) for ratio in RATIOS)
        solved = percent(share.solved / share.trials)
        rows.append((share.method, str(share.trials), solved, *within, shown(share.median)))
    ratios = (f"within {ratio:g} x least, %" for ratio in RATIOS)
    middle = "median time" if profile.work == "processor" else "median evaluations"
    show_sheet(FixSheet("", ("method", "trials", "solved, %", *ratios, middle), rows), console)
    console.print(solved_within(profile).shown.note, highlight=False, markup=False, soft_wrap=True)


def _show_histories(result: Any, reached: list[Any], tau: float, console: Console) -> None:
    """Print for each method how many trials reach the minimum, and the quartiles of the work."""
    console.print(result.title, style="bold", highlight=False, markup=False, soft_wrap=True)
    rows = []
    for reach in reached:
        counts = (_quartiles(reach.evaluations), _quartiles(reach.iterations))
        rows.append((reach.method, str(reach.trials), str(reach.reached), *counts))
    heads = ("trials", f"trials within {tau:g}", "median evaluations", "median iterations")
    show_sheet(FixSheet("", ("method", *heads), rows), console)
    console.print("In brackets: the other two quartiles.", highlight=False, markup=False)
    for remark in result.remarks:
        console.print(f"{remark}.", highlight=False, markup=False, soft_wrap=True)


def _quartiles(values: tuple[float, ...] | None) -> str:
    """Return three quartiles as text: the median, and the other two in brackets; a dash for None."""
    if values is None:
        return "-"
    low, middle, high = ("∞" if isinf(value) else f"{value:g}" for value in values)
    return f"{middle} [{low}, {high}]"
