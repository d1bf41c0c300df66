"""Replies: each request for an event gets its answers, early or late, and old answers are forgotten."""

import pytest
from service.lines import line, site_in

from optloc.service.events import Event, Events, RefusedRepeat
from optloc.service.messages import parse
from optloc.service.metrics import Metrics
from optloc.service.queues import Ticket
from optloc.service.replies import Replies

FIX = {"event": "1", "phase": "fix", "status": "unproven", "position": [1.0, 2.0], "reason": "later"}
PROOF = {"event": "1", "phase": "proof", "status": "ok", "proof": "global"}
WHOLE = {"event": "1", "status": "ok", "position": [1.0, 2.0], "proof": "global"}


def new_event(name="1"):
    return Event(name, {0: 1.0}, {}, 0.0, 0.0)


def ticket():
    """Return a ticket of one line, and the list that gets its records."""
    records = []
    return Ticket(1, records.extend), records


def test_requests_get_the_same_answer_before_between_and_after_the_phases():
    replies, event, found = Replies(), new_event(), []
    for step in (None, FIX, PROOF):
        if step is not None:
            replies.answer(event, step, step is PROOF)
        one, records = ticket()
        assert replies.attach(event, one)
        one.handled()
        found.append(records)
    assert found == [[WHOLE]] * 3


def test_a_receiver_that_repeats_its_line_is_answered_once():
    replies, event, calls = Replies(), new_event(), []
    one = Ticket(3, calls.append)
    for _ in range(2):
        assert replies.attach(event, one)
        one.handled()
    replies.answer(event, FIX, False)
    assert replies.answer(event, PROOF, True) == WHOLE
    assert calls == []
    assert replies.attach(event, one)
    one.handled()
    assert calls == [[WHOLE]]


def test_old_answers_and_answers_to_others_are_not_kept():
    replies, events = Replies(most=2), [new_event(str(i)) for i in range(4)]
    for event in events[:3]:
        assert replies.attach(event, ticket()[0])
    for event in events:
        replies.answer(event, WHOLE | {"event": event.name}, True)
    assert [replies.attach(event, ticket()[0]) for event in events] == [False, True, True, False]
    assert all(event.so_far is None and event.replies == [] for event in events)


def test_only_a_line_with_the_same_values_has_the_answer(tmp_path):
    site, replies = site_in(tmp_path), Replies()
    events = Events(site, Metrics(), lambda note: None, attach=replies.attach)
    z = [0.0] * 5

    def take(track=False, **found):
        one, records = ticket()
        events.take(parse(line(**({"event": "1", "z": z} | found)), site), 0.0, 0.0, one, track=track)
        one.handled()
        return records

    assert take(target="a", time=1) == []
    (event,) = events.closing()
    replies.answer(event, WHOLE, True)
    assert take() == take(target="a") == take(time=1) == [WHOLE]
    assert take(z=[0.0, None, None, None, None]) == [WHOLE]
    for other in ({"z": [1.0, *z[1:]]}, {"target": "b"}, {"time": 2}, {"track": True}):
        with pytest.raises(RefusedRepeat, match="the id is used with other values") as caught:
            take(**other)
        assert (caught.value.code, caught.value.name) == (409, "1")
        assert len(str(caught.value)) <= 200
    events.closed["2"] = None  # as after a restart
    with pytest.raises(RefusedRepeat, match="no longer kept") as caught:
        take(event="2")
    assert caught.value.code == 410


def test_an_open_event_refuses_other_values_and_takes_other_rows(tmp_path):
    site, replies = site_in(tmp_path), Replies()
    events = Events(site, Metrics(), lambda note: None, attach=replies.attach)

    def take(station, time):
        one, records = ticket()
        events.take(parse(line(event="1", station=station, time_ns=time), site), 0.0, 0.0, one)
        one.handled()
        return records

    found = [take("A", 1), take("B", 2), take("A", 1)]
    with pytest.raises(RefusedRepeat, match="other values: A"):
        take("A", 3)
    events.flush(0.0)
    (event,) = events.closing()
    assert (event.times, event.conflict) == ({0: 1000, 1: 2000}, False)
    replies.answer(event, WHOLE, True)
    assert found == [[WHOLE]] * 3
    with pytest.raises(RefusedRepeat, match="answered without C"):
        take("C", 3)
