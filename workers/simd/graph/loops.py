"""Loops carry the least they can. Brax's state is some 600 numbers, most of them functions of the others.

A carry is not needed where it stays what it was, and where its end is made of other carries' ends. Then it is

* *derived*, if its start is made in the same way of their starts (hash-consing shows it): computed from those at the
  start of each trip, as before at the end;
* *late*, if no trip looks at it: computed from the others' results, once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from workers.simd.graph.graph import Graph, Loop, depending, live
from workers.simd.graph.unsupported import UnsupportedError

Body = Callable[[list[int]], list[int]]
UNROLLED_OPERATIONS = 2000
"""A loop whose trips have no more than this many operations in all becomes straight code. Operations that hang on its
carries count: how many others there are depends on what else was built before, and rounding would, too."""
MOST_STRAIGHT_TRIPS = 64
"""Of a loop that can only be straight code, because its trips look at their numbers."""


def build_loop(graph: Graph, trips: int, body: Body, inits: Sequence[int]) -> list[int]:
    """Results of repeating `body` (carries -> their ends): a Loop with as few carries as will do, or straight code.

    `body` is called again for another set of carries, and must build the same for the same.
    """
    loop = graph.loop(trips, list(inits))
    try:
        outs = body(loop.carries)
    except UnsupportedError:
        if trips > MOST_STRAIGHT_TRIPS:
            raise
        return _straight(trips, body, inits)  # where the number of the trip is an index, it has to be a constant
    inside = depending(graph, loop)
    if trips * max(1, sum(bool(graph.arguments(node)) for node in inside)) <= UNROLLED_OPERATIONS:
        return _straight(trips, body, inits)
    kept, derived, late, firsts = _sort(graph, loop, outs, inside)
    if len(kept) == len(inits):
        return graph.close(loop, outs)

    # The same body again, on the carries that are kept and what is derived from them.
    reduced = graph.loop(trips, [inits[k] for k in kept])
    # Of carries with one end, the start that `_sort` compared with counts.
    starts = {outs[k]: carry for k, carry in zip(kept, reduced.carries, strict=True) if k in firsts}
    carries = list(inits)
    for k, carry in zip(kept, reduced.carries, strict=True):
        carries[k] = carry
    for k in derived:
        carries[k] = substitute(graph, outs[k], starts)
    for k in late:
        carries[k] = inits[k]  # nothing looks at it
    new_outs = body(carries)
    results = graph.close(reduced, [new_outs[k] for k in kept])
    found = list(inits)  # what is constant stays
    for k, result in zip(kept, results, strict=True):
        found[k] = result
    ends = dict(zip((outs[k] for k in kept), results, strict=True))
    for k in (*derived, *late):
        found[k] = substitute(graph, outs[k], ends)
    return found


def _straight(trips: int, body: Body, inits: Sequence[int]) -> list[int]:
    nodes = list(inits)
    for _ in range(trips):
        nodes = body(nodes)
    return nodes


def _sort(
    graph: Graph, loop: Loop, outs: Sequence[int], inside: set[int]
) -> tuple[list[int], list[int], list[int], list[int]]:
    """Positions of carries: (kept, derived, late, those whose start stands for all with the same end).

    What is in none of the first three stays what it was.
    """
    inits, carries = loop.inits, loop.carries
    candidates = [k for k, out in enumerate(outs) if out != carries[k]]
    used = live(graph, outs)
    first_with: dict[int, int] = {}
    for k in sorted(candidates, key=lambda k: carries[k] not in used):  # what trips look at comes first
        first_with.setdefault(outs[k], k)
    made_of_ends = {k for k in candidates if _made_of(graph, outs[k], set(first_with), inside)}
    # A late carry is computed from others, also where it did not start so: its start says nothing about what it is.
    starts = {out: inits[k] for out, k in first_with.items() if carries[k] in used or k not in made_of_ends}
    kept, derived, late = [], [], []
    for k in candidates:
        is_first = first_with[outs[k]] == k
        if is_first and k not in made_of_ends:
            kept.append(k)
        elif carries[k] not in used:
            late.append(k)
        elif inits[k] == substitute(graph, outs[k], starts, itself=not is_first):
            derived.append(k)
        else:
            kept.append(k)
    return kept, derived, late, list(first_with.values())


def _made_of(graph: Graph, node: int, ends: set[int], inside: set[int]) -> bool:
    """Whether a node inside a loop is made of other ends and of what is outside, by operations alone."""
    waiting, seen = list(graph.arguments(node)), set()
    if node in inside and not waiting:
        return False  # another carry, or an inner loop's result
    while waiting:
        one = waiting.pop()
        if one in seen or one not in inside or one in ends:
            continue
        seen.add(one)
        if not graph.arguments(one):
            return False
        waiting += graph.arguments(one)
    return True


def substitute(graph: Graph, node: int, replaced: Mapping[int, int], *, itself: bool = True) -> int:
    """The same operations on other nodes: those in `replaced`, but for the node itself if not `itself`."""
    copies = dict(replaced)
    if not itself:
        copies.pop(node, None)
    waiting = [node]
    while waiting:
        top = waiting[-1]
        missing = [a for a in graph.arguments(top) if a not in copies] if top not in copies else []
        if missing:
            waiting += missing
            continue
        waiting.pop()
        if top not in copies:
            key = graph.keys[top]
            copies[top] = graph.op(key[0], *(copies[a] for a in key[1:])) if graph.arguments(top) else top
    return copies[node]
