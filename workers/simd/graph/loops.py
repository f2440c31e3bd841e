"""Reduction of loops to the carries they need. Brax's state has about 600 numbers, most of them functions of others.

A carry is not needed if it never changes, or if its end is a function of the ends of other carries. In the second case
it is

* *derived*, if its start is the same function of their starts (hash-consing shows this): it is computed from the other
  carries at the start of each trip instead of at its end;
* *late*, if no trip reads it: it is computed once, from the results of the other carries.

A body is built once to find this out, and a second time only if trips read a carry that the loop does not need.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from workers.simd.graph.graph import Graph, Loop, UnsupportedError, depending, live

Body = Callable[[list[int]], list[int]]
UNROLLED_OPERATIONS = 2000
"""Most operations, over all trips, of a loop that becomes straight code.

Only operations that depend on the carries are counted. The number of others depends on what was built before, and
rounding would then depend on it as well.
"""
MOST_STRAIGHT_TRIPS = 64
"""Most trips of a loop that must become straight code because its body depends on the number of the trip."""


def build_loop(graph: Graph, trips: int, body: Body, inits: Sequence[int], lanes: int | None = None) -> list[int]:
    """Results of repeating `body`, which maps carries to their ends, as a Loop with few carries or as straight code.

    `body` is called again with other carries, and must build the same expressions from the same nodes.

    Args:
        lanes: bool node that says whether a lane's results are needed; None if those of all lanes are. The others may
            be anything, and no trip is made for them if the loop ends as soon as no lane needs another trip.
    """
    loop = graph.loop(trips, list(inits))
    try:
        outs = body(loop.carries)
    except UnsupportedError:
        if trips > MOST_STRAIGHT_TRIPS:
            raise
        return _straight(trips, body, inits)  # if the number of the trip is an index, it must be a constant
    inside = depending(graph, loop)
    if trips * max(1, _operations(graph, inside)) <= UNROLLED_OPERATIONS:
        return _straight(trips, body, inits)
    active = graph.ending(loop, outs)
    if active is not None and lanes is not None:
        loop.inits[active] = graph.op("and", lanes, inits[active])
    return _reduced(graph, loop, body, outs, inside)


def build_while(
    graph: Graph,
    condition: Callable[[list[int]], int],
    body: Callable[[list[int], int], list[int]],
    inits: Sequence[int],
    lanes: int | None = None,
) -> list[int]:
    """Results of repeating `body` while `condition`, a bool node, holds: as a Loop, or as straight code if it is short.

    Both are called several times.

    Args:
        body: function (carries, bool node that says which lanes need their ends) -> ends.
        lanes: see `build_loop`.
    """
    first = condition(list(inits))
    first = first if lanes is None else graph.op("and", lanes, first)

    def chosen(active: int, after: list[int], before: list[int]) -> list[int]:
        return [new if new == old else graph.choose(active, new, old) for new, old in zip(after, before, strict=True)]

    def trip(nodes: list[int]) -> list[int]:
        active, *before = nodes
        after = body(before, active)
        return [graph.op("and", active, condition(after)), *chosen(active, after, before)]

    loop = graph.loop(None, [first, *inits])
    outs = trip(loop.carries)
    inside = depending(graph, loop)
    # In straight code values go on after the end and only the results are chosen. So a counter stays a constant, and
    # the condition after the last possible trip folds to false.
    active, nodes, results = first, list(inits), list(inits)
    trips = min(UNROLLED_OPERATIONS // max(1, _operations(graph, inside)), MOST_STRAIGHT_TRIPS)
    for number in range(trips + 1):
        if graph.constant(active) is not None and not graph.constant(active):
            return results
        if number < trips:
            nodes = body(nodes, active)
            results = chosen(active, nodes, results)
            active = graph.op("and", active, condition(nodes))
    return _reduced(graph, loop, trip, outs, inside)[1:]


def _operations(graph: Graph, nodes: Iterable[int]) -> int:
    return sum(bool(graph.arguments(node)) for node in nodes)


def _is_long(graph: Graph, nodes: Iterable[int]) -> bool:
    """Whether no loop with these nodes in its body becomes straight code, however often they are counted."""
    return _operations(graph, nodes) > UNROLLED_OPERATIONS


def _reduced(graph: Graph, loop: Loop, body: Body, outs: list[int], inside: set[int]) -> list[int]:
    """Results of a loop, closed with the carries that it needs."""
    inits, used = loop.inits, live(graph, outs)
    kept, derived, late, firsts = _sort(graph, loop, outs, inside, used)
    dropped = {*range(len(inits))}.difference(kept)
    if not dropped or (_is_long(graph, inside) and used.isdisjoint(loop.carries[k] for k in dropped)):
        # Trips read nothing that is dropped, so the body would be the same if it were built again. To build it again
        # would double the time of all loops inside, once for each loop around them.
        loop.inits = [graph.const(graph.dtypes[init], 0) if k in dropped else init for k, init in enumerate(inits)]
        all_ends = graph.close(loop, [loop.carries[k] if k in dropped else out for k, out in enumerate(outs)])
        results = [all_ends[k] for k in kept]
    else:
        results = _closed_again(graph, loop, body, outs, kept, derived, firsts)
    all_results = list(inits)  # carries that never change
    for k, result in zip(kept, results, strict=True):
        all_results[k] = result
    ends = dict(zip((outs[k] for k in kept), results, strict=True))
    for k in (*derived, *late):
        all_results[k] = substitute(graph, outs[k], ends)
    return all_results


def _closed_again(
    graph: Graph, loop: Loop, body: Body, outs: list[int], kept: list[int], derived: list[int], firsts: list[int]
) -> list[int]:
    """Results of the carries that are kept, of a loop whose body is built again from them and what is derived from
    them; lists as of `_sort`."""
    reduced = graph.loop(loop.trips, [loop.inits[k] for k in kept])
    # Where several carries have the same end, use the start that `_sort` compared with.
    starts = {outs[k]: carry for k, carry in zip(kept, reduced.carries, strict=True) if k in firsts}
    carries = list(loop.inits)  # no trip reads those that are late
    for k, carry in zip(kept, reduced.carries, strict=True):
        carries[k] = carry
    for k in derived:
        carries[k] = substitute(graph, outs[k], starts)
    ends = body(carries)
    return graph.close(reduced, [ends[k] for k in kept])


def _straight(trips: int, body: Body, inits: Sequence[int]) -> list[int]:
    nodes = list(inits)
    for _ in range(trips):
        nodes = body(nodes)
    return nodes


def _sort(
    graph: Graph, loop: Loop, outs: Sequence[int], inside: set[int], used: set[int]
) -> tuple[list[int], list[int], list[int], list[int]]:
    """Positions of carries as (kept, derived, late, firsts).

    A carry that is in none of the first three lists never changes. `firsts` has, for each end, the one carry whose
    start represents all carries with that end.

    Args:
        used: nodes on which the ends of a trip depend.
    """
    inits, carries = loop.inits, loop.carries
    candidates = [k for k, out in enumerate(outs) if out != carries[k]]
    first_with: dict[int, int] = {}
    for k in sorted(candidates, key=lambda k: carries[k] not in used):  # carries that trips read come first
        first_with.setdefault(outs[k], k)
    made_of_ends = {k for k in candidates if _made_of(graph, outs[k], set(first_with), inside)}
    # A late carry is computed from others even if its start is no such function, so its start is not compared with.
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
    """Whether a node inside a loop is computed from other ends and from nodes outside, by operations alone."""
    waiting, seen = list(graph.arguments(node)), set()
    if node in inside and not waiting:
        return False  # another carry, or the result of an inner loop
    while waiting:
        argument = waiting.pop()
        if argument in seen or argument not in inside or argument in ends:
            continue
        seen.add(argument)
        if not graph.arguments(argument):
            return False
        waiting += graph.arguments(argument)
    return True


def substitute(graph: Graph, node: int, replaced: Mapping[int, int], *, itself: bool = True) -> int:
    """A node rebuilt with the nodes in `replaced` exchanged; the node itself is exchanged only if `itself` is true."""
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
