"""The wave of a measurement table: the speed that converts its times, wind, and two-way times."""

from __future__ import annotations

import json
from dataclasses import replace

from optloc.base.errors import InvalidProblem
from optloc.base.units import SPEED_OF_LIGHT, UNITS
from optloc.files.table_problem import Section, TableProblem
from optloc.files.wave_speed import WaveOptions, is_profile, profile_of, stated_speed, wind_of
from optloc.models import MODELS

_KEY = "propagation_speed"


def with_wave(problem: TableProblem, wave: WaveOptions) -> TableProblem:
    """Return the problem of a table with the stated wave, and with the wave speed in its report.

    Raises
    ------
    InvalidProblem
        For options that have no effect on the values of the table, and for a wave speed that is not understood.
    """
    depends = any(map(_depends_on_speed, problem.sections))
    # speeds of P and S waves are a line of the file, or a medium of layers
    picks = any(line.startswith(_KEY) for line in problem.lines) or "[medium]" in problem.after
    if wave.speed is not None and picks:
        raise InvalidProblem("--vp and --vs determine the speeds of P and S", "--wave-speed", "remove this option")
    if (wave.speed is not None or wave.wind is not None) and not depends:
        units = ", ".join(dict.fromkeys(section.unit for section in problem.sections))
        what = f"the values are in {units}, so the wave speed has no effect"
        raise InvalidProblem(what, "--wave-speed" if wave.speed else "--wind", "remove this option, or correct --unit")
    lines, after = list(problem.lines), list(problem.after)
    if wave.speed is None:
        words = f"{SPEED_OF_LIGHT:.9g} m/s, light (no --wave-speed)"
    elif is_profile(wave.speed):
        medium = profile_of(wave.speed, "--wave-speed")
        after += ["", "[medium]", 'kind = "layers"', f"depths = {medium.depths}", f"speeds = {medium.speeds}"]
        speeds = medium.speeds or []
        words = f"{min(speeds):.6g} to {max(speeds):.6g} m/s, {len(speeds)} depths of {wave.speed}"
    else:
        words = stated_speed(wave.speed, "--wave-speed").words
        lines.append(f"{_KEY} = {json.dumps(wave.speed, ensure_ascii=False)}")
    if wave.wind is not None:
        words += f"; wind ({', '.join(f'{v:.3g}' for v in wind_of(wave.wind, '--wind'))}) m/s"
        lines.append(f"wind = {json.dumps(wave.wind)}")
    sections = problem.sections
    if wave.two_way:
        sections = _two_way(sections, wave)
        words += ", there and back" + (f", {wave.turn_around} less" if wave.turn_around else "")
    about = problem.about + ((("wave", words),) if depends and not picks else ())
    return replace(problem, sections=sections, lines=tuple(lines), after=tuple(after), about=about)


def _depends_on_speed(section: Section) -> bool:
    """Return whether the wave speed converts the values of a section: times of a path, or frequencies."""
    quantity = MODELS[section.kind].quantity
    return (quantity == "length" and section.unit in UNITS["time"]) or (quantity == "speed" and section.unit == "Hz")


def _two_way(sections: tuple[Section, ...], wave: WaveOptions) -> tuple[Section, ...]:
    """Return the sections with two-way times as ranges; raise InvalidProblem if no section has ranges as times."""
    chosen = [section.kind == "range" and section.unit in UNITS["time"] for section in sections]
    if not any(chosen):
        kinds = " and ".join(dict.fromkeys(section.kind for section in sections))
        advice = "add --as range if they are times of the way there and back, or remove this option"
        raise InvalidProblem(f"the table has {kinds}, not ranges as times", "--two-way", advice)
    more = ["two_way = true"]
    more += [f"turn_around = {json.dumps(wave.turn_around)}"] if wave.turn_around is not None else []
    return tuple(
        replace(section, lines=(*section.lines, *more)) if two_way else section
        for section, two_way in zip(sections, chosen, strict=True)
    )
