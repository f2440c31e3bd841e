"""The nodes of a Ray cluster that must not work for a run, because of their code or their platform."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from es_service.dispatch.ray_nodes import Membership
from es_service.errors import EvaluationError


class Refusals:
    """Nodes that refuse. They get no more workers, and the user is told of each host once."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._nodes: dict[str, str] = {}
        """Node id -> what its first worker said, which names the host and the files."""

    def __bool__(self) -> bool:
        return bool(self._nodes)

    def add(self, node: str, said: str) -> None:
        """Remember what a worker said on a node, and tell it if it is new."""
        if said not in self._nodes.values():
            self._tell(said)
        self._nodes.setdefault(node, said)

    def without(self, nodes: Membership) -> Membership:
        """The nodes of the cluster, of which those that refuse give no room."""
        rooms, free = (
            {node: 0 if node in self._nodes else room for node, room in of.items()} for of in (nodes.rooms, nodes.free)
        )
        return replace(nodes, rooms=rooms, free=free)

    def check(self, nodes: Membership | None) -> None:
        """Raise EvaluationError if no other node has room.

        Args:
            nodes: those of the cluster that was joined; None: a Ray of our own, with one node.
        """
        if nodes is None or not self.without(nodes).room:
            raise EvaluationError(str(self))

    def elsewhere(self) -> dict[str, Any]:
        """Options of an actor that Ray must not place on these nodes. If no other node has room, the actor waits."""
        selector = {"ray.io/node-id": f"!in({','.join(sorted(self._nodes))})"}
        return {"scheduling_strategy": "SPREAD", "label_selector": selector}

    def __str__(self) -> str:
        return "; ".join(dict.fromkeys(self._nodes.values()))
