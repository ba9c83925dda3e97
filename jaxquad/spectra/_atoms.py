"""Sums over atoms of noise, of which few of a record reach each frequency."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Complex, Int


Effect = Complex[np.ndarray, "frequencies inputs width"]
_TOGETHER = 32  # frequencies that are multiplied at once
_NARROW = 4  # atoms of an effect, up to which places are fewer steps than frequencies


class Reach(NamedTuple):
    """The atoms from `first` to before `last` that have an effect at each frequency."""

    first: Int[np.ndarray, " frequencies"]
    last: Int[np.ndarray, " frequencies"]

    def reached(self, count: int) -> Bool[np.ndarray, " count"]:
        """Which of `count` atoms have an effect on any frequency."""
        edges = np.bincount(self.first, minlength=count + 1).astype(int)
        edges -= np.bincount(self.last, minlength=count + 1)
        return np.cumsum(edges)[:count] > 0

    def disjoint(self) -> bool:
        """Whether no atom reaches two frequencies."""
        order = np.argsort(self.first, kind="stable")
        first, last = self.first[order], self.last[order]
        return bool(np.all(first[1:] >= np.maximum.accumulate(last)[:-1]))


def reach_of(effect: Effect, first: Int[np.ndarray | Array, " frequencies"] | None) -> Reach:
    """Of effects that begin with the atom `first`; all with the same one, without it."""
    used = np.any(effect != 0, axis=1)
    width = np.where(np.any(used, axis=1), used.shape[1] - np.argmax(used[:, ::-1], axis=1), 0)
    begin = np.zeros(len(effect), int) if first is None else np.asarray(first)
    return Reach(begin, begin + width)


def sums_of_products(
    one: Complex[np.ndarray, "frequencies width"],
    other: Complex[np.ndarray, "frequencies width"],
    reach: Reach,
) -> Complex[np.ndarray, "frequencies frequencies"]:
    """Of `one` and the conjugate `other`, over the atoms that two frequencies share."""
    total = np.zeros((len(one), len(one)), complex)
    for begin in range(0, len(one), _TOGETHER):
        rows = np.arange(begin, min(begin + _TOGETHER, len(one)))
        low, high = int(np.min(reach.first[rows])), int(np.max(reach.last[rows]))
        near = np.flatnonzero((reach.first < high) & (reach.last > low))
        if one is other:  # the half above the diagonal says all
            near = near[near >= begin]
        mine, its = (_beside(*each, reach, low, high) for each in ((one, rows), (other, near)))
        total[np.ix_(rows, near)] = mine @ its.conj().T
    if one is other:
        below = np.tril_indices(len(one), -1)
        total[below] = total.T[below].conj()
    return total


def _beside(
    effect: Complex[np.ndarray, "frequencies width"],
    rows: Int[np.ndarray, " some"],
    reach: Reach,
    low: int,
    high: int,
) -> Complex[np.ndarray, "some atoms"]:
    """The effects of the atoms from `low` to before `high`, atom by atom."""
    found = np.zeros((rows.size, high - low), complex)
    for row, f in zip(found, rows, strict=True):
        begin, end = max(reach.first[f], low), min(reach.last[f], high)
        row[begin - low : end - low] = effect[f, begin - reach.first[f] : end - reach.first[f]]
    return found


def add_effects(
    into: Complex[np.ndarray, "atoms columns"],
    low: int,
    effect: Effect,
    reach: Reach,
    values: Complex[np.ndarray, "frequencies inputs columns"],
) -> None:
    """Add effects times `values`, over frequencies and inputs, to the atoms from `low` on."""
    high = low + len(into)
    if effect.shape[2] <= _NARROW and np.all(np.diff(reach.first) > 0):
        for place in range(effect.shape[2]):  # at which no two frequencies have the same atom
            atoms = reach.first + place
            here = (atoms >= low) & (atoms < high) & (atoms < reach.last)
            into[atoms[here] - low] += np.einsum("fi,fip->fp", effect[here, :, place], values[here])
        return
    for f in np.flatnonzero((reach.first < high) & (reach.last > low)):
        begin, end = max(reach.first[f], low), min(reach.last[f], high)
        mine = effect[f, :, begin - reach.first[f] : end - reach.first[f]]
        into[begin - low : end - low] += mine.T @ values[f]


def times_drive(
    effect: Effect,
    reach: Reach,
    driven: Int[np.ndarray, " driven"],
    drive: Complex[np.ndarray, "parameters driven roots"],
) -> Complex[np.ndarray, "frequencies inputs parameters roots"]:
    """Sums of effects and the conjugate `drive` by the `driven` atoms, which rise."""
    parameters, _, roots = drive.shape
    rows = np.ascontiguousarray(np.conj(np.swapaxes(drive, 0, 1))).reshape(driven.size, -1)
    found = np.zeros((*effect.shape[:2], parameters * roots), complex)
    begins, ends = np.searchsorted(driven, reach.first), np.searchsorted(driven, reach.last)
    for f in np.flatnonzero(begins < ends):
        taken = slice(begins[f], ends[f])
        found[f] = effect[f][:, driven[taken] - reach.first[f]] @ rows[taken]
    return found.reshape(*effect.shape[:2], parameters, roots)
