"""Adapters for the formats of others: ChirpStack and Mode S, and lines on which an adapter fails."""

import json

import pytest
from service.lines import EPOCH, Answers, answers, arrivals, line, site_in

from optloc.problem import InvalidProblem
from optloc.service.adapters import ChirpStack, ModeS, adapter_of, convert
from optloc.service.site import FAST
from optloc.service.standard_input import read_lines
from optloc.service.stream import Settings, Stream


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return site_in(tmp_path_factory.mktemp("site"), method=FAST)


def test_uplinks_of_chirpstack_are_events(site):
    times = arrivals(site, 1)[0]
    heard = [
        {"gatewayId": name, "rssi": -80, "fineTimeSinceGpsEpoch": f"{t // 10**12}.{t % 10**12 // 1000:09d}s"}
        for name, t in zip("ABCDEF", times, strict=True)
    ]
    heard += [{"gatewayId": "roaming", "fineTimeSinceGpsEpoch": "1.5s"}, {"gatewayId": "A2"}]
    uplink = {
        "deduplicationId": "3ac7e3c4",
        "deviceInfo": {"devEui": "0101010101010101", "tenantName": "x"},
        "fCnt": 12,
        "rxInfo": heard,
    }
    adapter = ChirpStack(site.stations)
    records, _ = answers(site, [adapter(json.dumps(uplink).encode())], phases="fix")
    (record,) = records
    assert (record["event"], record["target"], record["dof"]) == ("3ac7e3c4", "0101010101010101", 2)
    uplink["rxInfo"] = heard[-1:]
    (record,) = answers(site, [adapter(json.dumps(uplink).encode())], phases="fix")[0]
    assert "arrivals: the value is not a list of 1 to 4096 entries" in record["error"]
    assert adapter(b"nonsense") == b"nonsense"


def test_mode_s_messages_are_arrivals(site):
    adapter, bits = ModeS(site.stations), "8d4840d6202cc371c32ce0576098"
    nanoseconds = [t // 1000 - EPOCH // 1000 for t in arrivals(site, 1)[0]]

    def sent(start):
        return [
            adapter(json.dumps({"receiver": name, "mlat": {"t": (start + t) % (86_400 * 10**9), "m": bits}}).encode())
            for name, t in zip("FEDCBA", reversed(nanoseconds), strict=True)
        ]

    # once over midnight, and the same bits again
    lines = [*sent(86_400 * 10**9 - 9000), *sent(5 * 10**8)]
    records, health = answers(site, lines, phases="fix", wait=10.0)
    assert [(r["event"], r["target"], r["dof"]) for r in records] == [(f"{bits}-{i}", "4840d6", 2) for i in (0, 1)]
    assert records[0]["position"] == pytest.approx(records[1]["position"], abs=1e-3)
    assert health["malformed"] == 0
    assert adapter(b'{"sync": {}}') == b'{"sync": {}}'


def fails_for_letters(data):
    return line(event="1", z=[float(data)] * 5)


def test_an_adapter_that_fails_refuses_one_line():
    assert convert(None, b"x") == (b"x", "")
    assert convert(fails_for_letters, b"1")[1] == ""
    data, fault = convert(fails_for_letters, b"x")
    assert data == b"x"
    assert fault.startswith("the adapter cannot convert this line (ValueError: ")
    with pytest.raises(InvalidProblem, match="there is no format 'none'"):
        adapter_of("none", ())


def test_an_adapter_that_fails_ends_no_stream(site):
    out = Answers()
    stream = Stream(site, Settings(phases="fix"), out)
    data = iter([b"1\nx\n\n", b""])
    read_lines(lambda _: next(data), stream, "pipe", fails_for_letters)
    stream.close()
    assert stream.ended.wait(10.0)
    (refused,) = [record for record in out.records if "error" in record]
    assert (refused["line"], refused["source"]) == (2, "pipe")
    assert stream.health()["account"]["pipe"] == {"received": 2, "answered": 1, "refused": 1, "dropped": 0, "open": 0}
