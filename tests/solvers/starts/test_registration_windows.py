"""Windows of a run: few, spread over the run, and complete."""

from solvers.posing.scenes import registered, shifted

from optloc.solvers.starts.registration import run_of, steady_blocks
from optloc.solvers.starts.registration_windows import has_windows, relax_run, windows_of


def test_windows_are_few_and_start_the_run():
    problem = steady_blocks(registered(1).flat())
    run = run_of(problem)
    assert has_windows(problem, run)
    (given,) = windows_of(problem, run)
    assert len(given["z"]) == 6
    assert given["station"].shape == (6, 4, 2)
    assert given["time"] is None
    assert relax_run(problem).shape[0] == 1
    assert relax_run(shifted(1).flat()) is None
