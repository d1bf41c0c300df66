"""Events: closing, repeats, late and conflicting rows; the rows that arrivals give."""

import zlib

import numpy as np
import pytest
from service.lines import EPOCH, SITE, C, arrivals, differences, line, site_in

from optloc.base.errors import InvalidProblem
from optloc.service.events import Events, share_of
from optloc.service.messages import parse
from optloc.service.metrics import Metrics


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return site_in(tmp_path_factory.mktemp("site"))


def events_of(site, **settings):
    notes = []
    return Events(site, Metrics(), notes.append, **settings), notes


def take(events, now, **found):
    events.take(parse(line(**found), events.site), now, now)
    return [event.name for event in events.closing()]


def test_an_event_closes_when_all_stations_are_there_or_by_time(site):
    events, _ = events_of(site, wait=0.05)
    for i, name in enumerate("ABCDE"):
        assert take(events, 0.001 * i, event="1", station=name, time_ps=EPOCH + i) == []
    assert events.next_due == 0.05
    assert take(events, 0.02, event="1", station="F", time_ps=EPOCH) == ["1"]
    take(events, 1.0, event="2", station="A", time_ps=EPOCH)
    events.due(1.04, 1.04)
    assert list(events.closing()) == []
    events.due(1.05, 1.06)
    (closed,) = events.closing()
    assert (closed.name, closed.closed, closed.times) == ("2", "wait", {0: EPOCH})
    assert events.metrics.counts["incomplete"] == 1


def test_repeats_conflicts_and_late_rows_are_counted_and_named(site):
    events, notes = events_of(site)
    for time in (5, 5, 6):
        take(events, 0.0, event="1", station="A", time_ps=time)
    events.flush(0.0)
    (closed,) = events.closing()
    assert closed.conflict
    assert closed.times == {0: 5}
    take(events, 1.0, event="1", station="B", time_ps=7)
    take(events, 1.0, event="1", station="A", time_ps=5)
    take(events, 1.0, event="1", station="A", time_ps=9)
    counts = events.metrics.counts
    assert (counts["repeated"], counts["conflicts"], counts["late"], counts["events"]) == (2, 2, 1, 1)
    assert notes == [{"event": "1", "note": "late", "rows": ["B"]}, {"event": "1", "note": "conflict", "rows": ["A"]}]


def test_late_rows_make_another_answer_where_that_is_wanted(site):
    events, notes = events_of(site, revise=True)
    take(events, 0.0, event="1", station="A", time_ps=5)
    events.flush(0.0)
    assert [event.revision for event in events.closing()] == [1]
    events.take(parse(line(event="1", station="B", time_ps=7), site), 1.0, 1.0)
    (again,) = events.closing()
    assert (again.revision, again.times, again.closed) == (2, {0: 5, 1: 7}, "late")
    assert notes == []


def test_rows_of_open_events_are_bounded(site):
    events, _ = events_of(site, most=3)
    closed = [take(events, 0.0, event=str(i), station="A", time_ps=i) for i in range(5)]
    assert closed == [[], [], [], ["0"], ["1"]]
    assert len(events.open) == 3
    assert events.metrics.counts["early"] == 2


def test_closed_events_are_remembered_for_a_while(site, monkeypatch):
    monkeypatch.setattr("optloc.service.events.REMEMBERED", 3)
    events, notes = events_of(site)
    for i in range(5):
        take(events, 0.0, event=str(i), z=[0.0] * 5)
    assert list(events.closed) == ["2", "3", "4"]
    assert take(events, 0.0, event="4", z=[0.0] * 5) == []
    assert take(events, 0.0, event="0", z=[0.0] * 5) == ["0"]
    assert (events.metrics.counts["repeated"], notes) == (5, [])


def test_a_part_takes_its_events_and_leaves_the_others(site):
    parts = [events_of(site, part=(k, 3))[0] for k in range(3)]
    for i in range(300):
        for events in parts:
            take(events, 0.0, event=f"{i}", station="A", time_ps=i)
    names = [set(events.open) for events in parts]
    assert set.union(*names) == {str(i) for i in range(300)}
    assert sum(map(len, names)) == 300
    assert min(map(len, names)) > 60
    assert share_of("é", 1000) == zlib.crc32(b"\xc3\xa9") % 1000  # of its bytes, the same on every machine


def test_arrivals_make_the_rows_that_they_can(site):
    assert [row.name for row in site.between((0, 1, 2))] == ["tdoa B-A", "tdoa C-A"]
    # without the common reference the first that is there takes its place
    assert [row.name for row in site.between((1, 2, 3))] == ["tdoa C-B", "tdoa D-B"]
    assert site.between((3,)) == ()
    assert site.ready((3,), ()) is None


def test_arrivals_and_values_are_the_same_measurements(site):
    times = arrivals(site, 3)
    ready = site.ready(tuple(range(6)), ())
    since = np.array([[t - min(row) for t in row] for row in times], dtype=float)
    z = ready.si(since, np.zeros((3, 0)))
    assert z == pytest.approx(differences(site, times), abs=1e-6)
    assert ready.full.problem.count == 5
    values = site.ready((), site.rows)
    assert values.si(np.zeros((3, 0)), differences(site, times)) == pytest.approx(z, abs=1e-6)


def test_units_signs_and_noise_are_those_of_the_file(tmp_path):
    text = SITE.replace('kind = "tdoa"\n', 'kind = "tdoa"\nunit = "ns"\npositive = "b-farther"\n')
    site = site_in(tmp_path, text)
    times = arrivals(site, 2)
    first = np.array([[t - min(row) for t in row] for row in times], dtype=float)
    z = site.ready(tuple(range(6)), ()).si(first, np.zeros((2, 0)))
    # the file's value of b-farther: the time at b less that at a, nanoseconds
    given = np.array([[1e-3 * (row[0] - row[i]) for i in range(1, 6)] for row in times])
    assert site.ready((), site.rows).si(np.zeros((2, 0)), given) == pytest.approx(z, abs=1e-6)
    assert np.diagonal(site.ready((), site.rows).full.problem.noise.blocks[0].covariance[0]) == pytest.approx(50.0)
    assert C == pytest.approx(299_792_458.0)


def test_rows_may_have_standard_deviations_of_their_own(tmp_path):
    listed = 'rows = [{ a = "B", sigma = 4.0 }, { a = "C", sigma = 6.0 }]'
    text = SITE.replace('arrival_sigma = "5 m"\n', "").replace(SITE.splitlines()[-1], listed)
    site = site_in(tmp_path, text)
    ready = site.ready((), (site.rows[0], site.rows[1]._replace(sigma=7.0)))
    sigma = np.sqrt([block.covariance[:, 0, 0] for block in ready.full.problem.noise.blocks]).ravel()
    assert sigma == pytest.approx([4.0, 7.0])
    with pytest.raises(InvalidProblem, match="the noise of tdoa C-B is unknown"):
        site.ready((), (site.rows[0]._replace(at=-1, a="C", b="B"),))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('b = "A"\n', 'b = "A"\nunit = "furlong"\n', "furlong"),
        ('arrival_sigma = "5 m"\nb = "A"\nrows = [', 'sigma = 5.0\nb = "A"\nrows = [{ a = "B" }, ', "B-A occurs twice"),
        ('arrival_sigma = "5 m"\n', "", "no noise"),
        ("[[measurements]]", '[target]\nmotion = "constant_velocity"\n\n[[measurements]]', "constant_velocity"),
    ],
)
def test_a_site_that_no_stream_can_have_is_refused(tmp_path, old, new, said):
    with pytest.raises(InvalidProblem) as caught:
        site_in(tmp_path, SITE.replace(old, new, 1))
    assert said in str(caught.value)
