"""Which lanes follow which, and merging those that follow each other without a branch."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

from ldrl.towns.opendrive.lanes import LaneKey

__all__ = ["Chain", "Graph", "chains", "merge"]

Chain = tuple[LaneKey, ...]
"""Lanes that follow each other and become one."""
Node = TypeVar("Node", bound=Hashable)


class Graph(Generic[Node]):
    """Which nodes follow, and which come before, each node."""

    def __init__(self) -> None:
        self.after: dict[Node, list[Node]] = {}
        self.before: dict[Node, list[Node]] = {}

    def add(self, node: Node) -> None:
        """Add a node without links."""
        self.after[node], self.before[node] = [], []

    def join(self, a: Node, b: Node) -> None:
        """Let ``b`` follow ``a``."""
        if b not in self.after[a]:
            self.after[a].append(b)
            self.before[b].append(a)

    def cut(self, a: Node, b: Node) -> None:
        """Let ``b`` no longer follow ``a``."""
        self.after[a].remove(b)
        self.before[b].remove(a)

    def remove(self, node: Node) -> None:
        """Remove a node and its links."""
        for following in list(self.after[node]):
            self.cut(node, following)
        for preceding in list(self.before[node]):
            self.cut(preceding, node)
        del self.after[node], self.before[node]


def chains(graph: Graph[LaneKey]) -> Graph[Chain]:
    """The same graph with a chain of one lane in place of each lane."""
    result: Graph[Chain] = Graph()
    for key in graph.after:
        result.add((key,))
    for key, after in graph.after.items():
        for following in after:
            result.join((key,), (following,))
    return result


def merge(graph: Graph[Chain], together: Callable[[Chain, Chain], bool]) -> Graph[Chain]:
    """Merge chains that follow each other without a branch.

    Args:
        graph: the chains; a ring of them becomes one that follows itself.
        together: whether two such chains may become one.

    Returns:
        A new graph.
    """
    onto = {
        a: after[0]
        for a, after in graph.after.items()
        if len(after) == 1 and after[0] != a and graph.before[after[0]] == [a] and together(a, after[0])
    }
    inner = set(onto.values())
    merged: dict[Chain, list[Chain]] = {}  # by its first part: the parts
    covered: set[Chain] = set()
    # Those that no other one leads onto first: what is left then are rings, which may start anywhere.
    for first in sorted(graph.after, key=lambda chain: chain in inner):
        if first not in covered:
            parts = [first]
            while (following := onto.get(parts[-1])) not in (None, first):
                parts.append(following)
            merged[first] = parts
            covered.update(parts)
    whole = {first: sum(parts, ()) for first, parts in merged.items()}
    result: Graph[Chain] = Graph()
    for chain in whole.values():
        result.add(chain)
    for first, parts in merged.items():
        for following in graph.after[parts[-1]]:
            result.join(whole[first], whole[following])
    return result
