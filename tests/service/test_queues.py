"""Queues of a stream: bounded, in order, and tickets that wait for all answers of their lines."""

from collections import Counter
from threading import Event, Thread

from optloc.service.account import Account
from optloc.service.queues import Inbox, Outbox, QueuedLine, Ticket


def of(*numbers):
    return [QueuedLine(b"", number, "test", 0.0, 0.0) for number in numbers]


def test_lines_are_taken_in_their_order():
    inbox = Inbox()
    inbox.put(of(1, 2, 3))
    assert [line.number for line in inbox.take(2, 0.0)] == [1, 2]
    assert [line.number for line in inbox.take(2, 0.0)] == [3]
    assert inbox.take(2, 0.0) == []


def test_a_full_inbox_refuses_offers_and_drops_the_oldest_for_what_is_pushed():
    inbox = Inbox(most=2)
    assert inbox.offer(of(1, 2))
    assert not inbox.offer(of(3))
    assert inbox.push(of(3)[0]) == 1
    assert [line.number for line in inbox.take(9, 0.0)] == [2, 3]


def test_lines_of_a_source_that_waits_are_not_dropped_for_others():
    account = Account()
    inbox = Inbox(most=2, account=account)
    waits = [line._replace(source="pipe") for line in of(1, 2)]
    inbox.put(waits)
    assert inbox.push(of(3)[0]) == 1
    assert inbox.take(9, 0.0) == waits
    assert account.records()["test"] == {"received": 1, "answered": 0, "refused": 0, "dropped": 1, "open": 0}


def test_lines_that_find_no_place_are_counted():
    account = Account()
    inbox = Inbox(most=1, account=account)
    inbox.put(of(1))
    assert not inbox.offer(of(2, 3))
    assert account.records()["test"] == {"received": 3, "answered": 0, "refused": 2, "dropped": 0, "open": 1}
    inbox.close()
    inbox.put(of(4))
    assert inbox.push(of(5)[0]) == 1
    assert account.records()["test"] == {"received": 5, "answered": 0, "refused": 2, "dropped": 2, "open": 1}
    assert inbox.difference(Counter()) == {}
    assert inbox.difference(Counter(test=1)) == {"test": -1}
    told = []
    inbox.drop()
    assert account.records()["test"]["open"] == 0
    inbox = Inbox(most=1)
    inbox.offer([of(6)[0]._replace(ticket=Ticket(1, told.extend))])
    inbox.drop()
    assert told == [{"error": "the stream has ended", "line": 6, "source": "test"}]


def test_a_closed_inbox_gives_what_is_there_and_takes_no_more():
    inbox = Inbox()
    inbox.put(of(1))
    inbox.close()
    inbox.put(of(2))
    assert not inbox.offer(of(3))
    assert [line.number for line in inbox.take(9, 0.0)] == [1]
    assert inbox.take(9, 0.0) is None


def test_who_puts_into_a_full_inbox_waits_until_there_is_room():
    inbox, done = Inbox(most=1), Event()
    inbox.put(of(1))
    Thread(target=lambda: (inbox.put(of(2)), done.set()), daemon=True).start()
    assert not done.wait(0.02)
    inbox.take(1, 0.0)
    assert done.wait(5.0)


def test_an_outbox_writes_all_lines_and_names_the_events_that_are_answered():
    written = []
    answered = []
    outbox = Outbox(written.append, lambda: None, answered.extend)
    outbox.put(b"a\n")
    outbox.put(b"b\n", "event")
    outbox.close()
    assert (b"".join(written), answered) == (b"a\nb\n", ["event"])


def test_a_reader_that_is_gone_is_told_once_and_answers_no_event():
    def write(_):
        raise BrokenPipeError

    gone, answered = [], []
    outbox = Outbox(write, lambda: gone.append(1), answered.extend)
    outbox.put(b"a\n", "event")
    outbox.close()
    assert (outbox.failed, gone, answered) == (True, [1], [])


def test_a_ticket_is_done_when_its_lines_are_read_and_its_events_answered():
    done = []
    ticket = Ticket(2, done.append)
    ticket.expect()
    ticket.handled()
    ticket.answer({"event": "1", "phase": "fix", "status": "ok"}, last=False)
    ticket.handled({"event": "2", "error": "no such station"})
    assert done == []  # the proof is still to come
    ticket.answer({"event": "1", "phase": "proof", "proof": "global"}, last=True)
    first, second = done[0]
    assert first == {"event": "1", "status": "ok", "proof": "global"}
    assert second["error"] == "no such station"
