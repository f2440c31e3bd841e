"""What a generation has changed in the state, part by part: what the run store writes.

Contents are compared, so that no change of a search is lost, however it was made. Only an object whose arrays are
read-only is taken for unchanged because it is the same object.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from es_service.errors import StoreError
from es_service.loop.parts import (
    BEST,
    BLOCK_ENTRIES,
    COUNTERS,
    GEOMETRY_PART,
    OBSERVATIONS,
    WEIGHT,
    archive_to_parts,
    best_to_arrays,
    block_part,
    cell_part,
    centre_part,
    centre_to_arrays,
    counters_to_arrays,
    elite_part,
    elite_to_arrays,
    entries_to_parts,
    map_to_arrays,
    moments_to_arrays,
    weight_to_arrays,
)
from es_service.loop.state import RunState
from es_service.search import state_parts
from es_service.search.algorithms.base import SearchState
from es_service.search.maps.behaviour_map import COLUMNS, BehaviourMap, rows_in, unchanged_entries
from es_service.search.novelty import NoveltyArchive, empty_archive, same_entries
from es_service.search.state_parts import Arrays, same_arrays

Stored = Callable[[str], Mapping[str, np.ndarray]]
"""Returns a part of the state before, as it is stored."""


def changed_parts(state: RunState, before: RunState | None, stored: Stored | None = None) -> dict[str, Arrays | None]:
    """The parts of `state` that differ from `before`, None for those that it has not any more; all without `before`.

    Args:
        stored: needed with `before`.

    Raises:
        StoreError: the search's state is none that can be stored.
    """
    search, earlier = state.search, before.search if before is not None else None
    if wrong := _malformed(search, earlier):
        raise _refusal(state, wrong)
    parts: dict[str, Arrays | None] = {
        OBSERVATIONS: moments_to_arrays(state.observations),
        COUNTERS: counters_to_arrays(state),
    }
    earlier_centres = earlier.centres if earlier is not None else ()
    for index, centre in enumerate(search.centres):
        then = earlier_centres[index] if index < len(earlier_centres) else None
        if centre is not then:
            _compare(parts, centre_part(index), centre_to_arrays(centre), then and centre_to_arrays(then))
    parts |= dict.fromkeys(map(centre_part, range(len(search.centres), len(earlier_centres))))
    if earlier is None or search.weight is not earlier.weight:
        _compare(parts, WEIGHT, weight_to_arrays(search.weight), earlier and weight_to_arrays(earlier.weight))
    parts |= state_parts.changes(search.extra, earlier.extra if earlier is not None else {})
    parts |= archive_changes(search.archive, earlier.archive if earlier is not None else None)
    map_before = earlier.map if earlier is not None else None
    if search.map is not None and (search.map is not map_before or state.elites):
        parts |= map_changes(search.map, map_before) | _elite_changes(state, search.map, map_before, stored)
    if before is None or state.best is not before.best:
        _compare(parts, BEST, best_to_arrays(state.best), before and best_to_arrays(before.best))
    return parts


def _compare(parts: dict[str, Arrays | None], name: str, now: Arrays, then: Arrays | None) -> None:
    """Add a part if it differs from what it was before."""
    if then is None or not same_arrays(now, then):
        parts[name] = now


def archive_changes(archive: NoveltyArchive, before: NoveltyArchive | None) -> dict[str, Arrays | None]:
    """Blocks of the novelty archive from the first entry on that differs from `before`; None for removed blocks."""
    before = before or empty_archive(archive.descriptor_N_B.shape[1])
    same = same_entries(archive, before)
    if same == archive.size == before.size:
        return {}
    gone = range(-(-archive.size // BLOCK_ENTRIES), -(-before.size // BLOCK_ENTRIES))
    return {**archive_to_parts(archive, same), **dict.fromkeys(map(block_part, gone))}


def map_changes(map_: BehaviourMap, before: BehaviourMap | None) -> dict[str, Arrays | None]:
    """Parts of the cells whose entries differ from an earlier map, None for cells that are empty now; without an
    earlier map all of its parts."""
    parts: dict[str, Arrays | None] = {}
    if before is None or map_.geometry is not before.geometry or (map_.samples_N is None) != (before.samples_N is None):
        _compare(parts, GEOMETRY_PART, map_to_arrays(map_), before and map_to_arrays(before))
    same_N = unchanged_entries(map_, before) if before is not None else np.zeros(map_.size, bool)
    parts |= entries_to_parts(map_, np.flatnonzero(~same_N))
    return parts | dict.fromkeys(map(cell_part, _emptied(map_, before)))


def _emptied(map_: BehaviourMap, before: BehaviourMap | None) -> list[int]:
    """Cells that are filled in an earlier map and empty now."""
    return [] if before is None else before.cell_N[~rows_in(before, map_)[0]].tolist()


def _elite_changes(
    state: RunState, map_: BehaviourMap, before: BehaviourMap | None, stored: Stored | None
) -> dict[str, Arrays | None]:
    """Parts of the policies of elites: of those that the state brings, and of those whose entries have moved; None for
    emptied cells.

    Raises:
        StoreError: nobody has the policy of an entry.
    """
    was_N, row_N = rows_in(map_, before or map_)
    if before is None:
        was_N = np.zeros(map_.size, bool)
    else:
        for now, then in ((map_.generation_N, before.generation_N), (map_.centre_N, before.centre_N)):
            was_N[was_N] &= now[was_N] == then[row_N[was_N]]
    parts: dict[str, Arrays | None] = dict.fromkeys(map(elite_part, _emptied(map_, before)))
    parts |= {elite_part(cell): elite_to_arrays(elite) for cell, elite in state.elites.items()}
    for row in np.flatnonzero(~was_N):
        cell, generation, centre = (int(column[row]) for column in (map_.cell_N, map_.generation_N, map_.centre_N))
        if cell in state.elites:
            continue
        origin = before.cell_of(generation, centre) if before is not None else None
        if origin is None or stored is None:
            raise _refusal(
                state,
                f"the new elite of cell {cell} is centre {centre} of generation {generation}, which was neither "
                "evaluated now nor in the map before; if it comes from elsewhere, `SearchState.elites` must have its "
                "policy",
            )
        parts[elite_part(cell)] = dict(stored(elite_part(origin)))
    return parts


def _malformed(search: SearchState, earlier: SearchState | None) -> str:
    """What of a search's state is none that can be stored; empty if all is."""
    if not search.centres:
        return "the search has no centre; one must remain"
    if wrong := _malformed_centres(search, earlier):
        return wrong
    if earlier is not None and (search.map is None) != (earlier.map is None):
        return "the behaviour map was added or removed, which only `map.enabled` decides"
    if (earlier is None or search.extra is not earlier.extra) and (
        wrong := state_parts.problem(search.extra, earlier.extra if earlier is not None else {})
    ):
        return wrong
    map_before = earlier.map if earlier is not None else None
    return _malformed_map(search.map, map_before) if search.map is not None and search.map is not map_before else ""


def _malformed_centres(search: SearchState, earlier: SearchState | None) -> str:
    """Which new centre is none from which a generation could go on; empty if none is."""
    known = earlier.centres if earlier is not None else ()
    shape = (known or search.centres)[0].centre_D.shape
    for index, centre in enumerate(search.centres):
        if index < len(known) and centre is known[index]:
            continue
        centre_D = centre.centre_D
        if not isinstance(centre_D, np.ndarray) or centre_D.dtype != np.float32 or centre_D.shape != shape:
            now = f"{centre_D.dtype} {centre_D.shape}" if isinstance(centre_D, np.ndarray) else type(centre_D).__name__
            return f"centre {index} is {now}; it must be float32 {shape}"
        if not np.isfinite(centre_D).all():
            return f"centre {index} has {np.count_nonzero(~np.isfinite(centre_D))} values that are not finite"
    return ""


def _malformed_map(map_: BehaviourMap, before: BehaviourMap | None) -> str:
    """Which array of a map has another type, shape or content than its cells need; empty if none has."""
    needed = {"cell_N": "i8", **COLUMNS, **({} if map_.samples_N is None else {"samples_N": "i8"})}
    for name, type_ in needed.items():
        array = getattr(map_, name)
        shape = (map_.size, len(map_.geometry.bounds)) if name == "descriptor_N_B" else (map_.size,)
        if not isinstance(array, np.ndarray) or array.dtype != type_ or array.shape != shape:
            now = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
            return f"the map's {name} is {now}; it must be {np.dtype(type_)} {shape}"
    cells = map_.cell_N if before is None or map_.cell_N is not before.cell_N else map_.cell_N[:0]
    if len(np.unique(cells)) < len(cells) or not ((cells >= 0) & (cells < map_.geometry.size)).all():
        return f"the map's cells must be different ones from 0 to {map_.geometry.size - 1}"
    return ""


def _refusal(state: RunState, why: str) -> StoreError:
    saved = f" Everything up to generation {state.generation - 1} is saved." if state.generation else ""
    return StoreError(
        f"generation {state.generation} cannot be stored: {why}; the class SearchState in "
        f"es_service/search/algorithms/base.py describes what a state is.{saved}"
    )
