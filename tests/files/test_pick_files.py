"""Picks of HYPO71, NonLinLoc and QuakeML give the focus that they were simulated from."""

import sys
from types import ModuleType

import numpy as np
import pytest
from picks_of_an_event import FOCUS, NET, S_ALONE, VP, VS, picks, place, stations_csv

import optloc
from optloc import InvalidProblem
from optloc.cli.from_table import table_hints
from optloc.files import load_table
from optloc.files.csv_formats import is_log, read_table
from optloc.problem.noise import variances

SPEEDS = {"vp": f"{VP} m/s", "vs": f"{VS} m/s"}


def hypo71() -> str:
    """Return the picks as HYPO71 phase cards: columns 1-4, 5-8, 10-19, 20-24, 32-36 and 37-40."""
    lines = []
    for name in NET:
        times = {wave: time for station, wave, time in picks() if station == name}
        if name in S_ALONE:
            continue  # a card needs a P time
        p = times["P"]
        minute = p.replace(second=0, microsecond=0)
        line = f"{name:<4}IPU0 {p:%y%m%d%H%M}{(p - minute).total_seconds():5.2f}"
        if "S" in times:
            line = f"{line:<31}{(times['S'] - minute).total_seconds():5.2f}ES 1"
        lines.append(line)
    lines.insert(2, f"{'OLD':<4}EP 4 2404060132{40.0:5.2f}")
    return "\n".join([*lines, f"{'':<17}10", ""])


def nonlinloc() -> str:
    """Return the picks as NonLinLoc observations, with errors of 0.05 s (P) and 0.1 s (S)."""
    lines = ["# simulated picks"]
    for name, wave, time in picks():
        error = 0.05 if wave == "P" else 0.1
        lines.append(
            f"{name:<6} ?    ?    ? {wave:<6} ? {time:%Y%m%d} {time:%H%M} {time.second + time.microsecond / 1e6:9.4f} "
            f"GAU {error:9.2e} -1.00e+00 -1.00e+00 -1.00e+00"
        )
    return "\n".join([*lines, ""])


def quakeml() -> str:
    """Return the picks as a QuakeML document: phases as hints of P, and as phases of arrivals of S."""
    made, arrivals = [], []
    for i, (name, wave, time) in enumerate(picks()):
        hint = "<phaseHint>P</phaseHint>" if wave == "P" else ""
        made.append(
            f'<pick publicID="smi:local/pick/{i}"><time><value>{time.isoformat()}Z</value>'
            f'<uncertainty>0.05</uncertainty></time><waveformID networkCode="IV" stationCode="{name}"/>{hint}</pick>'
        )
        arrivals.append(
            f'<arrival publicID="smi:local/arrival/{i}"><pickID>smi:local/pick/{i}</pickID>'
            f"<phase>{wave}g</phase></arrival>"
        )
    origin = (
        '<origin publicID="smi:local/origin/1"><time><value>2024-04-06T01:32:38Z</value></time><latitude><value>42'
        f"</value></latitude><longitude><value>13</value></longitude>{''.join(arrivals)}</origin>"
    )
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n<q:quakeml xmlns:q="http://quakeml.org/xmlns/quakeml/1.2" '
        'xmlns="http://quakeml.org/xmlns/bed/1.2"><eventParameters publicID="smi:local/1">'
        '<event publicID="smi:local/e/1">'
        f"<preferredOriginID>smi:local/origin/1</preferredOriginID>{''.join(made)}{origin}</event></eventParameters>"
        "</q:quakeml>\n"
    )


def fixed(tmp_path, name, text, **options):
    """Return the fix of a file of picks, and the distance of its position from the focus, m."""
    (tmp_path / name).write_text(text)
    (tmp_path / "net.csv").write_text(stations_csv())
    fix = optloc.solve(load_table(tmp_path / name, stations=tmp_path / "net.csv", **SPEEDS, **options))
    return fix, float(np.linalg.norm(fix.position - place(*FOCUS)))


def test_hypo71_phase_cards(tmp_path):
    fix, error = fixed(tmp_path, "event.pha", hypo71(), sigma="0.05 s")
    assert fix.status.label == "ok"
    assert error < 100.0
    table = read_table(tmp_path / "event.pha")
    assert table.notes[0] == "picks with weight 4 are left out: 1; change their weight to use them"
    assert "picks have weights 1 to 3, which are 3/4, 1/2 and 1/4 of full weight" in table.notes[1]


@pytest.mark.parametrize("sigma", ["0.05 s", "p=0.05 s,s=0.05 s", "toa=50 ms"])
def test_the_variance_is_divided_by_the_weight_of_a_pick(tmp_path, sigma):
    shares = {0: 1.0, 1: 0.75, 2: 0.5, 3: 0.25}
    lines = hypo71().splitlines()
    cards = [i for i, line in enumerate(lines) if "IPU0" in line]
    for number, i in enumerate(cards):
        lines[i] = lines[i].replace("IPU0", f"IPU{number % 4}")
    fix, error = fixed(tmp_path, "event.pha", "\n".join([*lines, ""]), sigma=sigma)
    assert error < 100.0
    problem = load_table(tmp_path / "event.pha", stations=tmp_path / "net.csv", **SPEEDS, sigma=sigma)
    rows = np.flatnonzero(np.concatenate([np.full(one.count, one.kind == "toa") for one in problem.rows]))
    variance = variances(problem.noise, problem.count)[rows]
    expected = [(6000.0 * 0.05) ** 2 / shares[number % 4] for number in range(len(cards))]
    assert variance == pytest.approx(np.array(expected) * (VP / 6000.0) ** 2, rel=1e-6)
    plain = optloc.solve(load_table(tmp_path / "event.pha", stations=tmp_path / "net.csv", **SPEEDS, sigma=sigma))
    assert np.allclose(plain.position, fix.position)


def test_the_weights_of_both_picks_change_s_minus_p(tmp_path):
    (tmp_path / "event.pha").write_text(hypo71())
    (tmp_path / "net.csv").write_text(stations_csv())
    problem = load_table(tmp_path / "event.pha", stations=tmp_path / "net.csv", **SPEEDS, sigma="0.1 s", what="sp")
    speed = VP * VS / (VP - VS)
    # P has full weight, and S has 3/4
    assert variances(problem.noise, problem.count) == pytest.approx((speed * 0.1) ** 2 * (1.0 + 4.0 / 3.0) / 2.0)


def test_nonlinloc_observations_with_their_errors_and_an_s_alone(tmp_path):
    fix, error = fixed(tmp_path, "event.obs", nonlinloc())
    assert fix.status.label == "ok"
    assert error < 100.0
    assert len(read_table(tmp_path / "event.obs").columns["sigma_s"]) == len(picks())


def test_quakeml_by_obspy(tmp_path):
    pytest.importorskip("obspy", reason="QuakeML is read by obspy")
    fix, error = fixed(tmp_path, "event.xml", quakeml())
    assert fix.status.label == "ok"
    assert error < 100.0


def test_without_obspy_quakeml_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "obspy", None)
    with pytest.raises(InvalidProblem, match=r"event\.xml: QuakeML needs the package obspy, .* pip install obspy"):
        fixed(tmp_path, "event.xml", quakeml())


def test_picks_of_obspy_without_phase_are_left_out(tmp_path, monkeypatch):
    from types import SimpleNamespace as Record

    def pick(name, hint):
        station = Record(station_code=name)
        return Record(
            waveform_id=station, phase_hint=hint, time="2024-04-06T01:32:40Z", time_errors=None, resource_id=name,
            evaluation_status=None,
        )  # fmt: skip

    event = Record(preferred_origin=lambda: None, origins=[], picks=[pick("AQU", "P"), pick("FIAM", None)])
    module = ModuleType("obspy")
    module.read_events = lambda data, **_: [event]
    monkeypatch.setitem(sys.modules, "obspy", module)
    (tmp_path / "event.xml").write_text(quakeml())
    table = read_table(tmp_path / "event.xml")
    assert table.labels("station").tolist() == ["AQU"]
    assert table.notes == (
        "picks that are rejected, or without phase or station, are left out: 1; complete them to use them",
    )


@pytest.mark.parametrize("make", [hypo71, nonlinloc, quakeml])
def test_the_content_identifies_the_format_with_any_name(make, tmp_path):
    path = tmp_path / "event.dat"
    path.write_text(make())
    assert is_log(path)
    assert table_hints(path, {}) is not None


@pytest.mark.parametrize(
    ("make", "old", "new", "words"),
    [
        (hypo71, "240406", "241406", r"event\.dat, line \d+: '.*' is not a phase card; write station"),
        (nonlinloc, "FIAM   ?    ?    ? P      ? 20240406", "FIAM   ?    ?    ? P      ? 20241306", "not a NonLinLoc"),
    ],
)
def test_a_wrong_line_is_named(make, old, new, words, tmp_path):
    (tmp_path / "event.dat").write_text(new.join(make().rsplit(old, 1)))
    with pytest.raises(InvalidProblem, match=words) as error:
        read_table(tmp_path / "event.dat")
    assert len(str(error.value)) <= 200


def test_events_are_separated_by_blank_lines(tmp_path):
    text = nonlinloc()
    (tmp_path / "two.obs").write_text(text + "\n" + text.replace("20240406", "20240407"))
    assert {*read_table(tmp_path / "two.obs").columns["event"].tolist()} == {1, 2}
