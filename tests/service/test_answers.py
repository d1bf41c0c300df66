"""Records of fixes and proofs, and both phases as one."""

import json

from show.ranging import ranged

from optloc.base.types import Status
from optloc.service.answers import fix_records, join, proof_records, to_line, unproven_record, unsolved_record
from optloc.service.events import Event
from optloc.solvers import solve
from optloc.tracking.entry import scan_sentence

FIX = {"event": "7", "phase": "fix", "status": "ok", "sentence": Status.OK.sentence, "position": [1.0, 2.0]}


def event(**more):
    return Event("7", {}, {}, 0.0, 0.0, **({"closed": "whole"} | more))


def test_a_line_is_strict_json_with_null_for_what_is_not_finite():
    data = to_line({"a": float("nan"), "b": [1.0, {"c": float("inf")}]})
    assert json.loads(data) == {"a": None, "b": [1.0, {"c": None}]}
    assert data.endswith(b"\n")


def test_both_phases_are_one_record():
    proof = {"event": "7", "phase": "proof", "status": "ok", "proof": "global"}
    assert join(FIX | {"reason": "no proof yet"}, proof) == {k: v for k, v in FIX.items() if k != "phase"} | {
        "proof": "global"
    }
    assert join(None, proof) == {"event": "7", "status": "ok", "proof": "global"}


def test_an_event_says_what_is_not_as_usual_about_it():
    found = unsolved_record(event(closed="wait", revision=2, conflict=True, target="t"), error="why")
    assert found == {
        "event": "7", "phase": "fix", "error": "why", "position": None,
        "closed": "wait", "revision": 2, "conflict": True, "target": "t",
    }  # fmt: skip
    assert unsolved_record(event(), status="too few rows") == {
        "event": "7",
        "phase": "fix",
        "status": "too few rows",
        "sentence": Status.TOO_FEW_ROWS.sentence,
        "position": None,
    }
    assert unsolved_record(event(), phase="track", status="lost")["sentence"] == scan_sentence("lost")


def test_a_proof_that_was_not_finished_keeps_the_status():
    found = unproven_record(event(), "deadline", FIX, answered=True)
    assert (found["phase"], found["status"], found["proof"], found["why"]) == ("proof", "ok", "unknown", "deadline")
    assert (found["sentence"], "revision" in found) == (Status.OK.sentence, False)
    assert unproven_record(event(revision=2), "deadline", FIX, answered=True)["revision"] == 2
    whole = unproven_record(event(), "skipped: load", FIX | {"status": "unproven"}, answered=False)
    assert (whole["position"], whole["why"]) == ([1.0, 2.0], "skipped: load")
    assert "its proof was given up" in whole["sentence"]


def test_records_have_the_sentence_of_their_fix():
    problem, proven = ranged()
    first = solve(problem, "gtrs+lsr").flat()
    events = [event()]
    (alone,) = fix_records(first, events, "fix")
    (pending,) = fix_records(first, events, "fix", pending=True)
    assert alone["status"] == pending["status"] == "unproven"
    assert alone["sentence"] == first[0].sentence
    assert "no proof was tried" in alone["sentence"]
    assert "its proof is not finished" in pending["sentence"]
    (proof,) = proof_records(proven.flat(), events, [pending])
    assert (proof["status"], proof["sentence"]) == ("ok", proven.sentence)
    assert join(pending, proof)["sentence"] == proven.sentence
