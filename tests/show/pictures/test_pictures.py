"""Every picture is drawn without a warning, its axes carry units, no text covers another, and it tells the truth."""

import itertools
import warnings
from functools import cache
from importlib.resources import files as package_files

import numpy as np
import pytest
from matplotlib.text import Text
from often import few
from typer.testing import CliRunner

import optloc
from optloc.base.errors import InvalidProblem
from optloc.bounds.over_area import bound_map
from optloc.cli import app
from optloc.kernels.sums import equations_at
from optloc.show import pictures as plot
from optloc.show.pictures.landscape import limits, plane
from optloc.show.pictures.scene import scene_of
from optloc.solvers.landscape import End, basins, profile_cost
from optloc.solvers.running import growing

DEMOS = package_files("optloc") / "scenarios"
RUN = CliRunner()


@cache
def solved(name):
    problem = optloc.load(DEMOS / f"{name}.toml")
    problem = optloc.problem.by_epoch(problem) if name == "run" else problem
    return problem, optloc.solve(problem)


@cache
def grown():
    return growing(*solved("registration"), [4, 20, 60, 130, 200])


def bounded():
    problem, fix = solved("demo")
    return bound_map(problem, fix.x, np.linspace(11.0, 11.5, 24), np.linspace(47.65, 47.95, 24), 2000.0)


NOISE = np.array([1.0, 3.0, 10.0])
FIGURES = {
    "fix": lambda: plot.plot_fixes(*solved("demo"), "title"),
    "fix of two": lambda: plot.plot_fixes(*solved("ambiguous"), "title"),
    "fixes of a run": lambda: plot.plot_fixes(*solved("run"), "title"),
    "landscape": lambda: plot.plot_landscape(*solved("demo"), "title"),
    "landscape of two": lambda: plot.plot_landscape(*solved("ambiguous"), "title"),
    "landscape of a run": lambda: plot.plot_landscape(*solved("registration"), "title"),
    "convergence": lambda: plot.plot_convergence(*solved("demo"), "title", starts=15),
    "convergence of two": lambda: plot.plot_convergence(*solved("ambiguous"), "title", starts=15),
    "residuals": lambda: plot.plot_residuals(*solved("demo"), "title"),
    "residuals of a run": lambda: plot.plot_residuals(*solved("run"), "title"),
    "biases": lambda: plot.plot_biases(grown(), "title", truth={"clock": np.array([30.0, -40.0, 50.0, -30.0])}),
    "bound": lambda: plot.plot_bound_map(bounded(), "title"),
    "accuracy": lambda: plot.plot_accuracy(NOISE, {"one": 2.0 * NOISE, "two": 3.0 * NOISE}, 1.9 * NOISE, "title"),
}
# Pictures of the same kind as those before them.
ALIKE = {*(name for name in FIGURES if name.endswith("of two")), "landscape of a run"}


@pytest.mark.parametrize("name", few(sorted(FIGURES, key=ALIKE.__contains__), 6))
def test_a_picture_is_whole(name, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = FIGURES[name]()
        # how a format is written does not depend on the picture
        for ending in ("png", "svg", "pdf") if name == "residuals" else ("png",):
            plot.save(figure, tmp_path / f"p.{ending}")
            assert (tmp_path / f"p.{ending}").stat().st_size > 4_000
    for axes in figure.axes:
        if axes.axison and axes.get_xlabel():
            assert axes.get_xlabel().endswith(")"), axes.get_xlabel()
        if axes.axison and axes.get_ylabel():
            assert axes.get_ylabel().endswith(")"), axes.get_ylabel()
    assert any(axes.get_xlabel() for axes in figure.axes)
    # 700 pixels are the width of a page, and 9 pixels the smallest text
    sizes = [text.get_fontsize() for text in figure.findobj(Text) if text.get_text() and text.get_visible()]
    assert min(sizes) * 700.0 / (72.0 * figure.get_figwidth()) >= 9.0
    assert not list(overlapping(figure))


def overlapping(figure):
    """Yield pairs of texts whose boxes cover each other by more than a sliver, and texts that leave the figure."""
    figure.draw_without_rendering()
    boxes = []
    for axes in figure.axes:
        texts = [*axes.texts, axes.title, axes.xaxis.label, axes.yaxis.label]
        texts += [*axes.get_xticklabels(), *axes.get_yticklabels()] if axes.axison else []
        boxes += [(text.get_text(), text.get_window_extent()) for text in texts if shown(text, axes)]
    for legend in figure.legends:
        boxes += [(text.get_text(), text.get_window_extent()) for text in legend.get_texts()]
    if figure._suptitle is not None:
        boxes.append((figure.get_suptitle(), figure._suptitle.get_window_extent()))
    for (one, a), (two, b) in itertools.combinations(boxes, 2):
        wide, tall = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
        if wide > 1.5 and tall > 1.5:
            yield one, two
    for text, box in boxes:
        if box.x0 < -1 or box.y0 < -1 or box.x1 > figure.bbox.x1 + 1 or box.y1 > figure.bbox.y1 + 1:
            yield text, "leaves the figure"


def shown(text, axes):
    if not text.get_text() or not text.get_visible():
        return False
    inside = axes.get_window_extent().padded(2.0)
    if hasattr(text, "xy"):
        return inside.contains(*axes.transData.transform(text.xy))
    if text in axes.get_xticklabels():
        return inside.x0 <= axes.transData.transform((text.get_position()[0], 0.0))[0] <= inside.x1
    if text in axes.get_yticklabels():
        return inside.y0 <= axes.transData.transform((0.0, text.get_position()[1]))[1] <= inside.y1
    return True


def test_the_profile_is_the_least_cost_with_the_plan_held():
    """Beside a search over the height by a fine grid."""
    problem, fix = solved("demo")
    flat, rng = problem.flat(), np.random.default_rng(3)
    places = fix.position + np.pad(30.0 * rng.standard_normal((6, 2)), ((0, 0), (0, 1)))
    found = profile_cost(flat, fix.x, places, np.eye(3)[:2])
    heights = fix.position[2] + np.linspace(-600.0, 600.0, 4001)
    for place, cost in zip(places, found, strict=True):
        column = np.column_stack([np.tile(place[:2], (len(heights), 1)), heights])
        least = equations_at(flat, column).cost.min()
        assert cost == pytest.approx(least, rel=1e-4, abs=1e-4)
        assert cost <= least + 1e-9


def test_the_profile_of_a_run_gives_its_marginal_ellipse():
    """The profile over a place rises by the square of the step in units of the marginal covariance, clocks free."""
    problem, fix = solved("registration")
    semi_axes, directions = fix.ellipse(0.95)
    steps = np.array([1e-2 * semi_axes[i] * directions[:, i] for i in range(problem.dimension)])
    cost = profile_cost(problem.flat(), fix.x, fix.position + steps, np.eye(problem.dimension))
    expected = np.einsum("ni,ij,nj->n", steps, np.linalg.inv(fix.covariance()), steps)
    np.testing.assert_allclose(cost - fix.cost, expected, rtol=2e-2)


def test_ends_of_iterations_are_what_they_are_called():
    """A start at the fix reaches it; what ends elsewhere costs more; what is damped reaches it more often."""
    problem, fix = solved("demo")
    _, _, places = plane(limits(scene_of(problem.flat(), [fix.flat()]), 1.0), 25, fix.position)
    plain, damped = (basins(problem, fix, places.reshape(25, 25, 3), method) for method in ("taylor", "lsr"))
    assert basins(problem, fix, fix.position[None] + 1.0).ends.tolist() == [End.REACHED]
    assert plain.share(End.REACHED) < 0.15
    assert damped.share(End.REACHED) > 3.0 * plain.share(End.REACHED)
    assert plain.share(End.NOWHERE) > 0.7
    for found, method in ((plain, "taylor"), (damped, "lsr")):
        ended = optloc.solve(batch(problem, 625), method, start=places)
        reached = np.linalg.norm(ended.position - fix.position, axis=-1) < 1.0
        np.testing.assert_array_equal(found.ends.ravel() == End.REACHED, reached & ended.answered)
        other = found.ends.ravel() == End.ELSEWHERE
        assert (ended.cost[other] > fix.cost + 1.0).all()


def batch(problem, count):
    return problem.with_rows(z=np.tile(problem.z, (count, 1)))


def test_growing_ends_at_the_fix_and_its_intervals_are_true():
    found, fix = grown(), solved("registration")[1]
    values, sigma = found.take("clock")
    np.testing.assert_allclose(values[-1], fix.take("clock"), atol=0.01 * sigma[-1].max())
    np.testing.assert_allclose(sigma[-1], fix.sigma("clock"), rtol=1e-3)
    truth = np.array([100.0, -133.0, 167.0, -100.0]) * 1e-9 * 299792458.0
    assert (np.abs(values - truth)[1:] < 4.0 * sigma[1:]).all()
    assert (np.diff(sigma[1:], axis=0) < 0.0).all()


def test_what_cannot_be_drawn_is_a_sentence():
    problem, fix = solved("run")
    with pytest.raises(InvalidProblem, match="60 fixes"):
        plot.plot_landscape(problem, fix)
    with pytest.raises(InvalidProblem, match="do not belong"):
        plot.plot_residuals(problem, fix[0])
    with pytest.raises(InvalidProblem, match="does not grow"):
        growing(*solved("demo"))
    with pytest.raises(InvalidProblem, match="unknown iteration"):
        basins(*solved("demo"), np.zeros((1, 3)), "newton")
    with pytest.raises(InvalidProblem, match="not positive"):
        plot.plot_accuracy(np.zeros(1), {}, np.ones(1))


@pytest.mark.parametrize(
    ("what", "file"),
    few([("track", "run"), ("residuals", "run"), ("fix", "demo"), ("landscape", "run"), ("bound", "demo")], 2, 2),
)
def test_the_command_draws(what, file, tmp_path):
    out = tmp_path / "p.svg"
    done = RUN.invoke(app, ["plot", what, file, "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert out.stat().st_size > 5_000


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["landscap", "demo"], "did you mean 'landscape'"),
        (["landscape", "nowhere.toml"], "no such file"),
        (["landscape", "run", "--epoch", "x"], "there is no epoch 'x'"),
        (["biases", "demo"], "does not grow with the epochs"),
        (["accuracy", "demo"], "needs a study"),
        (["fix", "demo", "--out", "no/such/folder.png"], "cannot be written"),
    ],
)
def test_a_wrong_command_is_a_sentence(words, sentence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = RUN.invoke(app, ["plot", *words])
    assert done.exit_code == 2
    assert sentence in " ".join(done.output.split())
    assert "Traceback" not in done.output
