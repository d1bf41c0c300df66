"""Bearings of markers by a camera that turns, from small tables: its axes, its rate, groups and whole runs."""

import numpy as np
import pytest

import optloc
from optloc.base.errors import InvalidProblem
from optloc.lab.datasets.starloc import LAG, STILL, _rate, _sigma, dataset, read_run
from optloc.problem.noise import variances

MARKERS = {3: (4.0, 1.0, 1.0), 5: (3.0, -2.0, 0.5)}
TURN = 0.3  # radians from frame to frame, 0.1 s apart, around the vertical


@pytest.fixture
def folder(tmp_path):
    """Return a run of eight frames of a camera that moves along y; marker 5 is seen in five of them."""
    half = 0.5 * TURN * np.arange(8)
    names = [f"{kind}_{c}" for kind in ("nom", "cal") for c in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")]
    lines = [
        ",".join(map(str, ("R1", k, 0.1 * k, *2 * (0.0, 0.1 * k, 1.2, 0.0, 0.0, np.sin(half[k]), np.cos(half[k])))))
        for k in range(8)
    ]
    (tmp_path / "stations.csv").write_text(f"run,frame,t_s,{','.join(names)}\n" + "\n".join(lines))
    lines = [f"R1,{tag},{x},{y},{z}" for tag, (x, y, z) in MARKERS.items()]
    (tmp_path / "truth.csv").write_text("run,tag,x_m,y_m,z_m\n" + "\n".join(lines))
    lines = []
    for k in range(8):
        for tag, place in MARKERS.items():
            x, y, z = np.subtract(place, (0.0, 0.1 * k, 1.2))
            azimuth = np.arctan2(y, x) - TURN * k  # in the axes of the camera
            if tag == 3 or k < 5:
                lines.append(
                    f"R1,{k},{tag},{np.arctan2(np.sin(azimuth), np.cos(azimuth))},{np.arctan2(z, np.hypot(x, y))}"
                )
    (tmp_path / "measurements.csv").write_text("run,frame,tag,az_rad,el_rad\n" + "\n".join(lines))
    return tmp_path


def test_exact_bearings_are_those_of_the_markers(folder):
    run = read_run(folder, "R1", "nom")
    problem = run.problem()
    off = problem.observed - optloc.engine.predict(problem, run.truth.ravel())
    np.testing.assert_allclose(np.sin(off / 2.0), 0.0, atol=1e-9)


def test_noise_grows_with_the_rate_at_which_the_camera_turns(folder):
    run = read_run(folder, "R1", "nom")
    np.testing.assert_allclose(_rate(run.poses), TURN / 0.1)
    wanted = STILL**2 + (LAG * TURN / 0.1) ** 2
    np.testing.assert_allclose(variances(run.problem().noise, run.problem().count), wanted)
    assert _sigma(np.zeros(1)) == pytest.approx([STILL])


def test_markers_that_were_seen_less_than_six_times_are_left_out(folder):
    problem, truth = dataset(folder, form="run")
    assert truth.tolist() == [list(MARKERS[3])]
    assert problem.count == 16
    assert read_run(folder, "R1", "nom", without=(3,)).often().rows.empty


def test_halves_share_no_frame_and_groups_hold_six_bearings_of_one_marker(folder):
    run = read_run(folder, "R1", "cal")
    halves = [set(run.half(number).rows["frame"]) for number in (0, 1)]
    assert halves == [{0, 2, 4, 6}, {1, 3, 5, 7}]
    groups = run.groups(3, seed=1)
    np.testing.assert_array_equal(groups.truth, np.tile(MARKERS[3], (3, 1)))
    assert all(len(np.unique(place[:, 1])) == 6 for place in groups.place)


def test_a_turned_mount_turns_what_the_camera_calls_forward(folder):
    groups = read_run(folder, "R1", "nom").groups(2, seed=1)
    quarter = 2.0 * np.tan(np.pi / 4.0) * np.array([0.0, 0.0, 1.0])  # the quaternion along (1, turn / 2): 90 degrees
    turned = groups.turned(quarter)
    np.testing.assert_allclose(turned.axes[..., 0, :], groups.axes[..., 1, :], atol=1e-12)
    np.testing.assert_allclose(turned.axes[..., 1, :], -groups.axes[..., 0, :], atol=1e-12)


def test_other_runs_and_forms_are_refused(folder):
    with pytest.raises(InvalidProblem, match="run: 'R2' is unknown"):
        dataset(folder, run="R2")
    with pytest.raises(InvalidProblem, match="form: 'group' is unknown; did you mean 'groups'"):
        dataset(folder, form="group")
