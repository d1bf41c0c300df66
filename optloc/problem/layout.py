"""The parameter vector: the position of each unknown in it. Unknowns are shared by all epochs or local to one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod

from optloc.base.arrays import library
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Bias, Motion, Stations
from optloc.problem.clocks import state_of
from optloc.problem.forms import form_of, per_second

# Units for output. All internal values are SI.
_STATE = (("position", "m"), ("velocity", "m/s"), ("acceleration", "m/s^2"))
# Name, number of entries, unit and names of the members of a part, as in `Slot`.
_Part = tuple[str, int, str, tuple[str, ...]]


@dataclass(frozen=True, slots=True)
class Slot:
    """A named part of the parameter vector.

    Parameters
    ----------
    name : str
        For instance "position", "velocity[2]", "clock" or "emission".
    start, size : int
        Position within the shared part, or within the local part of an epoch, and number of entries.
    unit : str
        SI unit.
    members : tuple of str
        Names of the bias members or stations with equal shares of the slot; empty for the state of a target.
    """

    name: str
    start: int
    size: int
    unit: str
    members: tuple[str, ...] = ()

    @property
    def entries(self) -> tuple[str, ...]:
        """Return the names of the entries (size,): a coordinate, a member, or a member and a coordinate."""
        per = self.size // max(len(self.members), 1)
        axes = tuple("xyz"[:per]) if per > 1 else ("",)
        return tuple(f"{member} {axis}".strip() for member in self.members or ("",) for axis in axes)


@dataclass(frozen=True, slots=True)
class Layout:
    """The order of unknowns: the shared slots first, then the local slots of epoch 0, of epoch 1 and so on.

    The parameter vector has n shared entries, then l local entries for each of the k epochs. Its size is n + k l.

    Parameters
    ----------
    shared, local : tuple of Slot
        Unknowns of the whole run, and unknowns of each epoch.
    epochs : int
        Number of epochs k.
    """

    shared: tuple[Slot, ...]
    local: tuple[Slot, ...]
    epochs: int

    @property
    def n_shared(self) -> int:
        """Return the number n of shared unknowns."""
        return sum(slot.size for slot in self.shared)

    @property
    def n_local(self) -> int:
        """Return the number l of unknowns local to each epoch."""
        return sum(slot.size for slot in self.local)

    @property
    def size(self) -> int:
        """Return the length n + k l of the parameter vector."""
        return self.n_shared + self.epochs * self.n_local

    def find(self, name: str) -> tuple[Slot, bool]:
        """Return the slot with this name and whether it is shared; raise InvalidProblem for an unknown name."""
        for slots, is_shared in ((self.shared, True), (self.local, False)):
            for slot in slots:
                if slot.name == name:
                    return slot, is_shared
        known = ", ".join(slot.name for slot in (*self.shared, *self.local))
        raise InvalidProblem(f"there is no unknown {name!r}", "name", f"this problem has {known}")

    def shares(self, name: str) -> bool:
        """Return whether there is a shared unknown with this name."""
        return any(slot.name == name for slot in self.shared)

    def split(self, x: Array) -> tuple[Array, Array]:
        """Return the shared part (..., n) and the local part (..., k, l) of vectors (..., size)."""
        n = self.n_shared
        # Shared unknowns are first, so the blocks of an arrow-shaped matrix are slices of the vector.
        return x[..., :n], library(x).reshape(x[..., n:], (*x.shape[:-1], self.epochs, self.n_local))

    def take(self, x: Array, name: str) -> Array:
        """Return a named part of x (..., size): (..., q) for shared unknowns, (..., k, q) for local ones."""
        slot, is_shared = self.find(name)
        shared, local = self.split(x)
        return (shared if is_shared else local)[..., slot.start : slot.start + slot.size]

    def labels(self) -> tuple[str, ...]:
        """Return one label for each entry of the shared part, for instance "position x" or "clock B"."""
        return tuple(f"{slot.name} {entry}".strip() for slot in self.shared for entry in slot.entries)


def state_names(target: int, count: int, order: int) -> tuple[str, ...]:
    """Return the slot names of a target's state; they contain the target number if there are several targets.

    `count` is the number of targets. `order` is the number of derivatives: 0 position, 1 also velocity, 2 also
    acceleration.
    """
    suffix = f"[{target}]" if count > 1 else ""
    return tuple(name + suffix for name, _ in _STATE[: order + 1])


def emission_name(target: int, count: int) -> str:
    """Return the slot name of a target's emission time; `count` is the number of targets."""
    return f"emission[{target}]" if count > 1 else "emission"


def layout(
    stations: Stations,
    motions: Sequence[Motion],
    biases: Sequence[Bias],
    emitting: Sequence[int],
    epochs: int,
    bias_units: Sequence[str] = (),
) -> Layout:
    """Return the layout of a problem.

    Parameters
    ----------
    stations : Stations
        The stations give the dimension. If their positions or velocities are uncertain, their errors are unknowns.
    motions : sequence of Motion
        One for each target.
    biases : sequence of Bias
        Families of systematic errors.
    emitting : sequence of int
        Targets whose emission times are unknown.
    epochs : int
        Number of epochs.
    bias_units : sequence of str
        SI unit of the rows that each bias affects; empty if they have several units, or if the unit is not needed.
    """
    shared: list[_Part] = []
    local: list[_Part] = []
    for i, motion in enumerate(motions):
        if motion.known is None:
            parts = shared if motion.span == "run" else local
            units = (unit for _, unit in _STATE)
            names = state_names(i, len(motions), motion.order)
            parts.extend((name, stations.dimension, unit, ()) for name, unit in zip(names, units, strict=False))
    for bias, unit in zip(biases, bias_units or [""] * len(biases), strict=True):
        form = form_of(bias)
        parts = shared if form.steps is None else local
        size, members = prod(form.shape(bias, stations.dimension)), form.members(bias)
        entries = zip(state_of(bias), (form.unit(unit), per_second(unit)), strict=False)
        parts.extend((name, size, unit_of_state, members) for name, unit_of_state in entries)
    # Emission times are unknowns of one epoch. Station errors are unknowns of the span that the stations state.
    local.extend((emission_name(i, len(motions)), 1, "m", ()) for i in emitting)
    if stations.unknown_for:
        parts = shared if stations.unknown_for == "run" else local
        size = stations.count * stations.dimension
        parts.extend((name, size, unit, stations.names) for name, unit, _ in stations.errors)
    return Layout(_slots(shared), _slots(local), epochs)


def _slots(parts: list[_Part]) -> tuple[Slot, ...]:
    """Return the slots of consecutive parts of the vector."""
    slots, start = [], 0
    for name, size, unit, members in parts:
        slots.append(Slot(name, start, size, unit, members))
        start += size
    return tuple(slots)
