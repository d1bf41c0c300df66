"""Runs cases in forks of one warm process, and says what each did that it must not.

By hand: ``python -m fuzz.harness SEED FIRST COUNT`` (with ``tests`` on the path) prints a line for each fault,
and one of counts; ``python -m fuzz.harness SEED NUMBER`` writes the files of a case to the folder it is run in.
"""

import faulthandler
import gc
import hashlib
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from contextlib import chdir
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

from fuzz.cases import case_of

# What a case may take: processor time, which does not hang on what else runs, and memory. A kill comes at five times.
SECONDS, GIGABYTES = 20.0, 2.0
CLOCK = 5 * SECONDS
# Cases from which on it is worth while to load everything first.
MANY = 50


def warm(*, every: bool):
    """Load what the commands load, with their machine code, by running each, or one, on something known to be good."""
    from fuzz.originals import conversions, problems
    from fuzz.surfaces import SITE, foreign, recording, study_folder
    from typer.testing import CliRunner

    from optloc.cli import app

    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        runner = CliRunner()
        for held in [*problems().values(), *(files for files, _, _ in conversions().values())]:
            for name, data in held.items():
                Path(name).write_bytes(data)
        commands = [["fix", name.split()[0], "--json"] for name in problems()]
        commands += [["crlb", "demo", "--json"], ["check", "demo"], ["track", "run", "--json"], ["separate", "demo"]]
        commands += [["plot", "fix", "demo", "--out", "p.svg"], ["fix", "demo", "--geojson", "-"]]
        commands += [["simulate", "tdoa.toml", "--truth", "1500,900,400", "--out", "s.toml"]]
        commands += [["fix", "demo", "-m", "robust"], ["check", "run", "--out", "h.parquet"]]
        commands += [["convert", next(iter(held)), *more, "--force"] for held, more, _ in conversions().values()]
        for command in commands if every else [["fix", "demo", "--json"]]:
            code = runner.invoke(app, command).exit_code
            assert code in (0, 1), (command, code)
        if every:
            for held, options in foreign().values():
                for name, data in held.items():
                    Path(name).write_bytes(data)
                runner.invoke(app, ["fix", next(iter(held)), *options, "--json"])
            Path("live.toml").write_text(SITE)
            Path("rec.ndjson").write_text(recording())
            runner.invoke(app, ["live", "live.toml", "--replay", "rec.ndjson"])
            study_folder()
    parser()
    # Forks share what is here; a collection of garbage would copy it.
    gc.collect()
    gc.freeze()


def run(case, folder, *, again=False):
    """Return what a case did that it must not, and what became of it.

    Parameters
    ----------
    case : Case
        The case.
    folder : Path
        A new folder is made in it and removed again.
    again : bool
        Whether this is the second time: a fork may wait for ever for a lock of a thread that it did not inherit.
    """
    place = Path(tempfile.mkdtemp(dir=folder))
    here = place / "here"
    here.mkdir()
    for name, data in case.files.items():
        (here / name).parent.mkdir(parents=True, exist_ok=True)
        (here / name).write_bytes(data)
    before = _listing(place)
    out, err, verdict = (folder / name for name in ("out", "err", "verdict"))
    verdict.unlink(missing_ok=True)
    started = time.monotonic()
    child = os.fork()
    if child == 0:
        _child(case, here, out, err, verdict)
    code, usage, late = _wait(child, started)
    if late and not again and usage.ru_utime + usage.ru_stime < 1.0:
        shutil.rmtree(place)
        return run(case, folder, again=True)
    faults = outcome(code, err.read_text(errors="replace")) + _limits(usage, late)
    after = _listing(place)
    asked = [f"here/{pattern}" for pattern in case.asked]
    others = {name for name in {*before, *after} if not any(fnmatch(name, pattern) for pattern in asked)}
    faults += [f"input {name} changed" for name in before if name in others and before[name] != after.get(name)]
    faults += [f"stray file {name}" for name in sorted(others - set(before))]
    said = verdict.read_text() if verdict.exists() else ""
    if said.startswith("mismatch"):
        faults.append(said)
    shutil.rmtree(place)
    return faults, {"code": code, "seconds": usage.ru_utime + usage.ru_stime, "verdict": said.partition(":")[0]}


def _listing(place):
    return {
        str(path.relative_to(place)): hashlib.blake2b(path.read_bytes()).hexdigest() if path.is_file() else "folder"
        for path in sorted(place.rglob("*"))
    }


def _child(case, here, out, err, verdict):
    """Run the command as its own process would, and leave without a word to the one that was forked."""
    code = 70
    try:
        os.setsid()
        os.chdir(here)
        for path, number in ((out, 1), (err, 2)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        limit = _reserved() + int(GIGABYTES * 2**30)
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        sys.stdout, sys.stderr = (open(n, "w", encoding="utf-8", closefd=False) for n in (1, 2))  # noqa: SIM115
        faulthandler.enable()
        code = command(case.arguments)
        sys.stdout.flush()
        sys.stderr.flush()
        if case.family == "problem":
            from fuzz.oracle import judge

            answer = out.read_text(encoding="utf-8")
            verdict.write_text(judge(Path(next(iter(case.files))), case.arguments, code, answer))
    except BaseException:  # noqa: BLE001  (whatever it is, the fork must not go on as the process that it was)
        traceback.print_exc()
        code = 71
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


@cache
def parser():
    """Return the parser of all commands, which takes longer to build than most cases to run."""
    from typer.main import get_command

    from optloc.cli import app

    return get_command(app)


def command(arguments):
    """Return the exit code of a command; what it does not catch goes to standard error as of any process."""
    try:
        parser()(list(arguments), prog_name="optloc")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:  # noqa: BLE001  (as the interpreter does)
        traceback.print_exc()
        return 1
    return 0


def _reserved():
    """Return the address space of this process: much is reserved and never used, so the limit goes on top."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


def _wait(child, started):
    """Return exit code and resources of a fork, and whether it had to be killed."""
    late = False
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() - started > CLOCK:
            late = True
            os.killpg(child, signal.SIGKILL)
        time.sleep(0.002)
    return os.waitstatus_to_exitcode(status), usage, late


def outcome(code, err):
    """Return what is wrong with an exit code and what was said on standard error."""
    # A busy machine loads machine code slowly, which a line of progress shows.
    said = [line for line in err.strip().splitlines() if "machine code" not in line]
    faults = [f"exit code {code}: {said[-1] if said else ''}"] if code not in (0, 1, 2) else []
    if "Traceback" in err:
        where = [line.strip() for line in said if line.lstrip().startswith("File") and "/optloc/" in line]
        place = where[-1].rpartition("/optloc/")[2] if where else "?"
        faults.append(f"traceback: {said[-1][:200]} in {place}")
    elif code == 2 and len(said) != 1:
        faults.append(f"{len(said)} lines on standard error: {said[:2]}")
    warned = [line for line in said if "Warning:" in line]
    if warned and "Traceback" not in err:
        faults.append(f"warning: {warned[0][-200:]}")
    return faults


def _limits(usage, late):
    seconds = usage.ru_utime + usage.ru_stime
    faults = [f"{seconds:.0f} s of processor time, {SECONDS:.0f} at most"] if late or seconds > SECONDS else []
    if usage.ru_maxrss > GIGABYTES * 2**20:
        faults.append(f"{usage.ru_maxrss / 2**20:.1f} GB, {GIGABYTES:.0f} at most")
    return faults


def run_part(seed, first, count):
    """Return the faults of some cases, and counts of what became of all."""
    counts, faults = Counter(), []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(first, first + count):
            case = case_of(seed, number)
            found, about = run(case, Path(folder))
            counts[f"exit {about['code']}"] += 1
            counts[f"{case.family}, exit {about['code']}"] += 1
            counts[about["verdict"] or "no verdict"] += 1
            faults += [f"case {case.name}: {fault}" for fault in found]
            for fault in found:  # at once: a run of many thousand cases is watched
                sys.stderr.write(f"case {case.name}: {fault}\n")
                sys.stderr.flush()
    return faults, counts


def main():
    """Run, or write, the cases that the command line names."""
    seed, first, *more = sys.argv[1:]
    if not more:
        case = case_of(int(seed), int(first))
        for name, data in case.files.items():
            Path(name).parent.mkdir(parents=True, exist_ok=True)
            Path(name).write_bytes(data)
        sys.stdout.write(f"optloc {' '.join(case.arguments)}\n")
        return
    warm(every=int(more[0]) >= MANY)
    faults, counts = run_part(int(seed), int(first), int(more[0]))
    sys.stdout.write(json.dumps({"faults": faults, "counts": counts}) + "\n")


if __name__ == "__main__":
    main()
