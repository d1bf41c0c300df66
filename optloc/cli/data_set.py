"""The command ``optloc fix`` for a folder of Parquet files: an account of the statuses of all partitions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from optloc.base.errors import InvalidProblem
from optloc.base.types import Status
from optloc.cli.from_table import hints_of_options
from optloc.cli.output import Screen, dumps, meter, say, write_text
from optloc.files.constraint_table import ConstraintTable
from optloc.partitions.executors import TaskExecutor, task_executor
from optloc.partitions.fix_data_set import FixAccount, fix_data_set
from optloc.partitions.fix_options import FixOptions

# Largest number of partitions on a screen. The others are counted; --json has all.
_PARTITIONS = 12


def executor_of(name: str | None, scheduler: str | None, jobs: int | None) -> TaskExecutor:
    """Return the executor of the options; a scheduler implies dask, as in studies."""
    return task_executor(name or ("local" if scheduler is None else "dask"), jobs, scheduler)


def run_data_set(
    folder: Path,
    out: Path | None,
    method: str,
    more: Mapping[str, ConstraintTable],
    given: Mapping[str, Any],
    by: TaskExecutor,
    *,
    as_json: bool = False,
    quiet: bool = False,
    allow: tuple[Status, ...] = (),
) -> int:
    """Fix a data set, print the account, and return the exit code: 2 if a partition could not be fixed.

    `folder` is the data set, and `out` the folder of the fixes. `more` has the constraints by the name of their option,
    and `given` the values of the table options. `by` is the executor. `allow` has the statuses that give exit code 0 as
    well as ok.
    """
    if out is None:
        raise InvalidProblem("a folder is a data set, whose fixes need another folder", str(folder), "add --out DIR")
    options = FixOptions(hints_of_options(given), method, more)
    with meter("partitions", quiet or as_json) as advance:
        account = fix_data_set(folder, out, options, by, advance)
    if as_json:
        write_text(Path("-"), dumps(_record(account)))
    elif not quiet:
        _show(account, out, Screen())
    if account.failed:
        others = f" ({len(account.failed)} partitions failed)" if len(account.failed) > 1 else ""
        Screen(stderr=True).print(
            next(iter(account.failed.values())) + others, highlight=False, markup=False, soft_wrap=True
        )
        return 2
    passing = {Status.OK.label, *(status.label for status in allow)}
    return 0 if set(account.counts) <= passing else 1


def _record(account: FixAccount) -> dict[str, Any]:
    """Return the account as a JSON value."""
    return {
        "partitions": [{"name": one.name, "statuses": one.counts} for one in account.finished],
        "failed": dict(account.failed),
        "kept": account.kept,
        "statuses": account.counts,
        "fixes": sum(account.counts.values()),
    }


def _show(account: FixAccount, out: Path, console: Console) -> None:
    """Print a table of the statuses of partitions, the total, and the failed partitions."""
    statuses = list(account.counts)
    table = Table(title="Fixes by partition", title_justify="left")
    table.add_column("partition")
    for name in ("fixes", *statuses):
        table.add_column(name, justify="right")
    for one in account.finished[:_PARTITIONS]:
        counts = [one.counts.get(status, 0) for status in statuses]
        table.add_row(one.name, str(sum(counts)), *map(str, counts))
    table.add_section()
    total = list(account.counts.values())
    table.add_row("all", str(sum(total)), *map(str, total))
    console.print(table)
    more = len(account.finished) - _PARTITIONS
    if more > 0:
        say(console, f"{more} more partitions are in the total; --json prints all.")
    for sentence in account.failed.values():
        say(console, f"Not fixed: {sentence}")
    kept = f", {account.kept} of them by an earlier run" if account.kept else ""
    say(console, f"{len(account.finished)} partitions are fixed{kept}. The fixes are in {out}.")
