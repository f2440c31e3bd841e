"""In which order a graph is computed, what inside of which loop, and which products are fused with their sums."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from workers.simd.graph.graph import Graph, Loop, depending, live


@dataclass
class Region:
    """Straight code with loops in it: the whole kernel, or the body of a loop."""

    loop: Loop | None
    carried: list[int] = field(default_factory=list)
    """Positions of the loop's carries that somebody needs."""
    steps: list[int | Region] = field(default_factory=list)
    """Nodes to compute, and loops to run, in this order."""
    wanted_inside: set[int] = field(default_factory=set)
    """Nodes computed here that a loop in here looks at."""


class Schedule(NamedTuple):
    """How a graph is computed."""

    region: Region
    fused: dict[int, int]
    """Sum or difference -> the product it takes in: both become one operation, rounded once."""


def schedule(graph: Graph, outputs: Sequence[int]) -> Schedule:
    """Each node is computed as late as can be, before what first needs it."""
    needed = live(graph, outputs)
    numbers = sorted({graph.keys[node][2] for node in needed if graph.keys[node][0] == "carry"})
    bodies = {number: depending(graph, graph.loops[number]) & needed for number in numbers}
    home: dict[int, int | None] = dict.fromkeys(needed)
    for number in sorted(numbers, key=lambda number: -len(bodies[number])):
        home.update(dict.fromkeys(bodies[number], number))
    outside = {number: _outside(graph, graph.loops[number], bodies[number], needed) for number in numbers}

    def build(number: int | None, targets: Sequence[int]) -> Region:
        region = Region(None if number is None else graph.loops[number])
        if region.loop is not None:
            region.carried = [k for k, carry in enumerate(region.loop.carries) if carry in needed]
            targets = [region.loop.outs[k] for k in region.carried]
        done: set[int] = set()
        waiting = list(reversed(targets))
        while waiting:
            node = waiting[-1]
            key = graph.keys[node]
            if node in done or home[node] != number or not _is_made(graph, node):
                waiting.pop()
                continue
            first = outside[key[2]] if key[0] == "result" else graph.arguments(node)
            missing = [one for one in first if one not in done and home[one] == number and _is_made(graph, one)]
            if missing:
                waiting += reversed(missing)
                continue
            waiting.pop()
            if key[0] == "result":
                inner = graph.loops[key[2]]
                region.steps.append(build(inner.number, ()))
                region.wanted_inside.update(one for one in outside[key[2]] if home[one] == number)
                done.update(inner.results)
            else:
                region.steps.append(node)
                done.add(node)
        return region

    return Schedule(build(None, outputs), _fused(graph, needed, outputs, home))


def _is_made(graph: Graph, node: int) -> bool:
    return graph.keys[node][0] not in ("const", "input", "carry")


def _outside(graph: Graph, loop: Loop, body: set[int], needed: set[int]) -> list[int]:
    """Nodes outside of a loop that it, or a loop inside of it, looks at or starts from."""
    found = {one for node in body for one in graph.needs(node)}
    found.update(loop.inits[k] for k, carry in enumerate(loop.carries) if carry in needed)
    return sorted(found - body)


def _fused(graph: Graph, needed: set[int], outputs: Sequence[int], home: dict[int, int | None]) -> dict[int, int]:
    """A sum takes in a product that nobody else needs and that is computed in the same place; of two, the later one."""
    uses = Counter(one for node in needed for one in graph.needs(node))
    uses.update(outputs)
    found = {}
    for node in sorted(needed):
        if graph.keys[node][0] in ("add", "sub"):
            products = [
                one
                for one in graph.arguments(node)
                if graph.keys[one][0] == "mul" and uses[one] == 1 and home[one] == home[node]
            ]
            if products:
                found[node] = max(products)
    return found
