"""Models that interact, against a plain second program and against models side by side."""

import numpy as np
import pytest

from optloc.base.errors import InvalidProblem
from optloc.base.types import Status
from optloc.lab.papers.kinematic import FILTERS, KinematicScenario, draw, score_track
from optloc.tracking import UPDATES, State, polynomial, predicted
from optloc.tracking.several_models import imm, mixed, moments, parallel, resized
from optloc.tracking.track import scans

CHAIN = np.array([[0.9, 0.07, 0.03], [0.05, 0.9, 0.05], [0.1, 0.1, 0.8]])
MODELS = (polynomial(0), polynomial(1, 50.0), polynomial(2, 20.0))


@pytest.fixture(scope="module")
def drawn():
    scene = KinematicScenario()
    return draw(scene, scene.course(2, since=22.5), 3, (21,))


def plain(problem, fix, models, chain):
    """Return means, covariances and probabilities of the models, one run, loops over everything."""
    states = [resized(fix, m.order, 2, speed=2e3, rate=1e3) for m in models]
    x, P = [s.mean for s in states], [s.cov for s in states]
    mu, now, out = np.full(len(models), 1.0 / len(models)), 0.0, []
    for time, _ in list(scans(problem, 0))[1:]:
        c = np.array([sum(mu[i] * chain[i, j] for i in range(len(models))) for j in range(len(models))])
        x0, P0 = [], []
        for j in range(len(models)):
            n, parts = len(x[j]), []
            for i in range(len(models)):
                m, V = x[j].copy(), P[j].copy()
                k = min(n, len(x[i]))
                m[:k], V[:k, :k] = x[i][:k], P[i][:k, :k]
                if k < n:
                    V[:k, k:] = V[k:, :k] = 0.0
                parts.append((mu[i] * chain[i, j] / c[j], m, V))
            mean = sum(w * m for w, m, _ in parts)
            x0.append(mean)
            P0.append(sum(w * (V + np.outer(m - mean, m - mean)) for w, m, V in parts))
        fit = np.zeros(len(models))
        for j, model in enumerate(models):
            ahead = predicted(State(now, x0[j], P0[j]), model, time, 2)
            scan = next(s for t, s in scans(problem, model.order) if t == time)
            done = UPDATES["ekf"](scan, ahead.mean, ahead.cov)
            x[j], P[j], fit[j] = done.mean, done.cov, done.loglikelihood
        mu = c * np.exp(fit - fit.max())
        mu, now = mu / mu.sum(), time
        wide = [np.pad(v, (0, 6 - len(v))) for v in x]
        mean = sum(w * v for w, v in zip(mu, wide, strict=True))
        spread = [np.pad(V, (0, 6 - len(V))) for V in P]
        cov = sum(w * (V + np.outer(v - mean, v - mean)) for w, v, V in zip(mu, wide, spread, strict=True))
        out.append((mean, cov, mu.copy()))
    return [np.array(part) for part in zip(*out, strict=True)]


def test_models_that_interact_agree_with_a_plain_second_program(drawn):
    run = drawn.runs.flat().take(np.array([4]))
    fix = State(0.0, drawn.fix.mean[1, 1], drawn.fix.cov[1, 1])
    single = run.with_rows(z=run.z[0])
    mean, cov, mu = plain(single, fix, MODELS, CHAIN)
    made = imm(single, fix, MODELS, CHAIN, speed=2e3, rate=1e3, update="ekf")
    assert made.probability == pytest.approx(mu, rel=1e-6, abs=1e-9)
    assert made.track.mean == pytest.approx(mean, rel=1e-6, abs=1e-6)
    assert np.abs(made.track.cov - cov).max() < 1e-6 * np.abs(cov).max()


def test_a_batch_is_its_runs(drawn):
    together = imm(drawn.runs, drawn.fix, MODELS, CHAIN, speed=2e3, rate=1e3)
    for index in ((0, 0), (2, 1)):
        run = drawn.runs.with_rows(z=drawn.runs.z[index])
        fix = State(0.0, drawn.fix.mean[index], drawn.fix.cov[index])
        alone = imm(run, fix, MODELS, CHAIN, speed=2e3, rate=1e3)
        assert together.probability[index] == pytest.approx(alone.probability, rel=1e-6, abs=1e-12)
        assert together.track.mean[index] == pytest.approx(alone.track.mean, rel=1e-7, abs=1e-5)


def test_models_that_never_change_are_models_side_by_side(drawn):
    never = imm(drawn.runs, drawn.fix, MODELS, np.eye(3), speed=2e3, rate=1e3)
    beside = parallel(drawn.runs, drawn.fix, MODELS, speed=2e3, rate=1e3)
    assert never.probability == pytest.approx(beside.probability, rel=1e-6, abs=1e-12)
    assert np.cumsum(never.track.loglikelihood, -1) == pytest.approx(
        np.log(np.exp(beside.score - beside.score.max(-1, keepdims=True)).mean(-1)) + beside.score.max(-1), rel=1e-9
    )


def test_one_model_is_itself(drawn):
    alone = imm(drawn.runs, drawn.fix, MODELS[1:2], np.ones((1, 1)), speed=2e3)
    (track,) = parallel(drawn.runs, drawn.fix, MODELS[1:2], speed=2e3).tracks
    assert alone.track.mean == pytest.approx(track.mean, rel=1e-12)
    assert alone.track.nis == pytest.approx(track.nis, rel=1e-9)
    assert (alone.track.count == 3).all()
    assert (alone.track.code == Status.OK).all()


def test_moments_are_those_of_samples():
    rng = np.random.default_rng(1)
    means, covs, weight = [np.zeros(2), np.array([3.0, 1.0])], [np.eye(2), np.diag([4.0, 0.25])], np.array([0.3, 0.7])
    which = rng.random(400_000) < weight[0]
    drawn = [rng.multivariate_normal(m, V, 400_000) for m, V in zip(means, covs, strict=True)]
    samples = np.where(which[:, None], *drawn)
    mean, cov = moments(means, covs, weight)
    assert mean == pytest.approx(samples.mean(0), abs=0.02)
    assert cov == pytest.approx(np.cov(samples.T), abs=0.04)


def test_an_impossible_model_keeps_its_state_and_nothing_becomes_infinite():
    states = [State(0.0, np.zeros(2), np.eye(2)), State(0.0, np.ones(4), 2.0 * np.eye(4))]
    out, coming = mixed(states, np.array([1.0, 0.0]), np.eye(2))
    assert (coming == [1.0, 0.0]).all()
    assert (out[1].mean == 1.0).all()
    assert (out[1].cov == 2.0 * np.eye(4)).all()


def test_a_scan_without_rows_leaves_the_chain_alone(drawn):
    weight = np.ones(drawn.runs.count)
    weight[drawn.runs.epoch == 5] = 0.0
    made = imm(drawn.runs.with_rows(weight=weight), drawn.fix, MODELS, CHAIN, speed=2e3, rate=1e3)
    assert (made.track.code[..., 4] == Status.TOO_FEW_ROWS).all()
    assert made.probability[..., 4, :] == pytest.approx(made.probability[..., 3, :] @ CHAIN, rel=1e-12)
    assert np.isnan(made.track.nis[..., 4]).all()


def test_a_model_that_loses_the_state_gets_no_weight(drawn):
    def broken(scan, mean, cov):
        done = UPDATES["ekf"](scan, mean, cov)
        if mean.shape[-1] == 6:
            done.mean[...] = np.nan
        return done

    made = imm(drawn.runs, drawn.fix, MODELS, CHAIN, speed=2e3, rate=1e3, update=broken)
    assert (made.probability[..., 2] == 0.0).all()
    assert np.isfinite(made.track.mean).all()
    assert (made.track.code == Status.OK).all()


def test_a_target_that_begins_to_accelerate_is_followed():
    scene = KinematicScenario()
    late = draw(scene, scene.course(2, since=22.5), 60, (22,))
    errors = {f.name: f.run(late).mean for f in FILTERS}
    best = errors[FILTERS[4].name]
    assert best == min(errors.values())
    assert best < 900.0
    assert errors[FILTERS[3].name] > 1.5 * best  # side by side: nobody forgets
    found = imm(late.runs, late.fix, FILTERS[4].models, np.array([[0.95, 0.05], [0.05, 0.95]]), speed=2e3, rate=1e3)
    assert found.probability[..., 9, 0].mean() > 0.6
    assert found.probability[..., -1, 1].mean() > 0.75
    assert score_track(late, found.track).nees[..., -1].mean() == pytest.approx(2.0, abs=0.6)


def test_runs_may_share_a_start_and_begin_with_a_scan_of_no_rows(drawn):
    one = State(0.0, drawn.fix.mean[0, 0], drawn.fix.cov[0, 0])
    runs = drawn.runs.with_rows(weight=np.where(drawn.runs.epoch == 1, 0.0, 1.0))
    same = State(0.0, *(np.broadcast_to(v, (3, 3, *v.shape)) for v in (one.mean, one.cov)))
    for start in (one, same):
        made = imm(runs, start, MODELS, CHAIN, speed=2e3, rate=1e3)
        assert made.track.mean.shape == (3, 3, 20, 6)
        beside = parallel(runs, start, MODELS, speed=2e3, rate=1e3)
        assert beside.score.shape == (3, 3, 20, 3)
        assert beside.position.shape == (3, 3, 20, 2)


@pytest.mark.parametrize("chain", [np.eye(2), np.full((3, 3), 0.5), np.array([[2.0, -1.0, 0.0]] * 3)])
def test_tables_that_are_no_probabilities_are_refused(drawn, chain):
    with pytest.raises(InvalidProblem, match="transition"):
        imm(drawn.runs, drawn.fix, MODELS, chain, speed=2e3, rate=1e3)
