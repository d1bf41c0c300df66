"""The command line of the recorder."""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from pathlib import Path

from cases import CASES

from recorder.comparison import KINDS, Tolerance, compare
from recorder.listing import listing
from recorder.recording import Record, read, record
from recorder.scope import VARIANTS, scenes, shipped_methods

# CPU seconds of a fix that is worth a look: on one core, all fixes but a few of all cases take less.
SLOW = 2.0


def main(arguments: list[str] | None = None) -> int:
    """Run one command and return its exit status: 1 for differences, 2 for a file that is no recording."""
    options = _parser().parse_args(arguments)
    # Every fix takes machine code: else the first fixes of a process are those of plain Python.
    os.environ["OPTLOC_COMPILE"] = "wait"
    try:
        return options.run(options)
    except (OSError, ValueError) as error:
        _say(f"recorder: {error}", sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("python -m recorder", description="Compare the fixes of two versions of optloc.")
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("record", help="solve all cases by all methods, and write the fixes to a file")
    one.add_argument("out", type=Path)
    one.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), metavar="CASE")
    one.add_argument("--methods", nargs="+", default=list(shipped_methods()), metavar="METHOD")
    one.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    one.add_argument("--seeds", nargs="+", type=int, default=[0, 1], metavar="SEED")
    one.add_argument("--slow", type=float, default=SLOW, metavar="S", help="list fixes that take more CPU seconds")
    one.set_defaults(run=_record)
    two = commands.add_parser("compare", help="list the differences of two recordings")
    two.add_argument("old", type=Path)
    two.add_argument("new", type=Path)
    two.add_argument("--tolerance", type=float, default=1.0, metavar="F", help="times the tolerances; 0: all bits")
    two.add_argument("--ignore", nargs="+", choices=KINDS, default=[], metavar="KIND", help=f"of {', '.join(KINDS)}")
    two.add_argument("--most", type=int, metavar="N", help="lines of each group that are printed")
    two.set_defaults(run=_compare)
    return parser


def _record(options: argparse.Namespace) -> int:
    chosen = {name: getattr(options, name) for name in ("cases", "methods", "variants", "seeds")}
    drawn = scenes(options.cases, options.variants, options.seeds)
    fixes = record(options.out, drawn, options.methods, chosen, lambda line: _say(line, sys.stderr))
    for method in options.methods:
        _say(_method_line(method, [fix for fix in fixes if fix["method"] == method]))
    for fix in sorted(fixes, key=lambda fix: -fix["seconds"]):
        if fix["seconds"] > options.slow:
            _say(f"slow: {fix['case']} {fix['variant']} seed {fix['seed']} {fix['method']}: {fix['seconds']:.1f} s")
    _say(f"{len(fixes)} fixes, {sum(fix['seconds'] for fix in fixes):.0f} CPU seconds")
    return 0


def _method_line(method: str, fixes: list[Record]) -> str:
    statuses = Counter(fix.get("status", "exception") for fix in fixes)
    counts = ", ".join(f"{status} {count}" for status, count in statuses.most_common())
    return f"{method}: {counts}; {sum(fix['seconds'] for fix in fixes):.1f} CPU seconds"


def _compare(options: argparse.Namespace) -> int:
    old, new = read(options.old), read(options.new)
    found = compare(old, new, Tolerance().times(options.tolerance))
    found = [difference for difference in found if difference.kind not in options.ignore]
    for line in listing(old, new, found, options.most):
        _say(line)
    return 1 if found else 0


def _say(line: str, stream: object = None) -> None:
    print(line, file=stream, flush=True)


if __name__ == "__main__":
    sys.exit(main())
