"""What the papers do between a guess and an answer, against other programs for the same."""

import numpy as np
import pytest
from lab.study.texts import QUICK, design

from optloc.base.types import Status
from optloc.lab.papers.registration import PRINTED, RegistrationSetting
from optloc.lab.papers.registration_recursion import recursion as printed
from optloc.lab.study.baselines import BASELINES, recursion, single_step
from optloc.lab.study.simulation import draw
from optloc.lab.study.trial import compute
from optloc.solvers.pool import begin
from optloc.solvers.stages import lsr
from optloc.solvers.verdict.judge import judge


def test_the_recursion_is_that_of_the_paper():
    setting = RegistrationSetting(PRINTED, 3, 1, 1)
    run, start = setting.draw(120), setting.starts(1.0)
    wanted = printed(PRINTED.track(120), PRINTED.times(120), run.z.reshape(3, 120, 4), start)[:, -1]
    found = recursion(run, np.concatenate([start, np.zeros((3, 4))], axis=1))
    assert np.abs(found - wanted).max() < 1e-6


def test_a_single_step_is_the_first_of_an_iteration():
    drawn = draw(next(design().chunks).cell.case, 0, 5)
    start = drawn.truth + 500.0
    once = judge(drawn.problem, lsr(drawn.problem, begin(drawn.problem, start), damped=False, limit=1))
    np.testing.assert_allclose(single_step(drawn.problem, start), once.x, rtol=1e-9)


def test_a_recursion_over_runs_with_unknowns_of_their_epochs_has_no_answer():
    text = 'format = 1\nname = "x"\ntrials = 4\n[[scenario]]\nname = "s"\nlayout = { kinds = ["toa"] }\n'
    text += 'truth = { kind = "hull" }\nnoise = ["3 m"]\n[[method]]\nbaseline = "recursion"\n'
    frame = compute(next(design(text).chunks)).table.to_pandas()
    assert not frame["answered"].any()


@pytest.mark.parametrize("name", ["single-step", "recursion"])
def test_originals_claim_what_they_arrive_at(name):
    drawn = draw(next(design().chunks).cell.case, 0, 5)
    fix = BASELINES[name].run(drawn, drawn.truth)
    assert (fix.code == Status.UNPROVEN).all()
    assert fix.answered.all()
    best = BASELINES["truth"].run(drawn, drawn.truth)
    assert (fix.cost >= best.cost - 1e-9).all()


def test_methods_that_know_the_truth_are_references_whatever_their_names():
    text = QUICK + '[[method]]\nname = "judge"\nbaseline = "truth"\n[[method]]\nname = "a"\nbaseline = "taylor"\n'
    text += '[[method]]\nname = "b"\nbaseline = "taylor"\nstart = "truth"\n'
    methods = {cell.method.name: cell.method for cell in design(text).cells}
    assert {name for name, method in methods.items() if method.reference} == {"judge", "b"}
