"""Random towns: a rectangle cut into blocks by straight streets, some of which are taken away again.

Each cut ends in two T-junctions, or in a four-way junction where it meets the end of another. Taking streets away
leaves corners, bent blocks and a ragged outline. Then some corners are bevelled and the whole is turned.
"""

from __future__ import annotations

import math
import random
from itertools import pairwise

from ldrl.towns.layout import Layout, Node

__all__ = ["random_layout"]

BLOCKS = (3, 12)
"""Blocks of a town when not told; Town 1 has 7, Town 2 has 5."""
BLOCK_AREA = (7000.0, 18000.0)
"""Mean area of a town's blocks before streets are taken away; Town 1's is 18500, Town 2's 7800, m^2."""
ASPECT = (0.6, 1.6)
"""Width by height of the rectangle."""
SPACING = 40.0
"""Least distance of two junctions, 49 in the built-in towns; streets that would end closer meet in one, m."""
CROSSINGS = 0.4
"""Share of streets that go for the nearest end of another opposite, however far, to make a four-way junction."""
MISSING = 0.4
"""Streets taken away, at most, by blocks that stay."""
LANE_WIDTH = (3.7, 4.5)
"""At 3.5 m an expert's car that turns left with a radius of 6 m has its corner 3 cm from the road's edge, m."""
JUNCTION_RADIUS = (6.0, 12.0)
"""Of the turning centre lines; 5.8 to 10.8 in the built-in towns, m."""
CORNER_RADIUS = (7.0, 20.0)
"""m."""
CORNER_SHARE = 0.3
"""The part of a street that one of its corners may take up."""
BEVELLED = 0.35
"""Share of the corners to bevel, where both streets are at least ``BEVEL_STREET`` long."""
BEVEL_STREET = 60.0
"""m."""
BEVEL = (12.0, 35.0)
"""How far before the corner a bevel leaves the street, m."""

Point = tuple[float, float]
Graph = dict[Point, list[Point]]
"""The neighbours of each node; lists, because the order of a set is not the same everywhere."""


def random_layout(seed: int, blocks: int | None = None) -> Layout:
    """A random town of straight streets, corners, T- and four-way junctions, whose lanes all lead to each other.

    :meth:`Town.load <ldrl.towns.Town.load>` makes the town from its name.

    Args:
        seed: the same seed makes the same town on every platform.
        blocks: areas that the streets enclose; there are about three streets to one. Town 1 has 7, so 70 make a
            town ten times as large. Drawn from 3 to 12 when not told.

    Returns:
        A layout named ``random-<seed>``, or ``random-<seed>-<blocks>`` when told how many.

    Raises:
        ValueError: fewer than two blocks.

    Examples:
        >>> random_layout(0).name, random_layout(0, blocks=4).name
        ('random-0', 'random-0-4')
    """
    if blocks is not None and blocks < 2:
        raise ValueError(f"blocks is {blocks}; a town needs at least 2 to have a junction")
    name = f"random-{seed}" if blocks is None else f"random-{seed}-{blocks}"
    rng = random.Random(name)
    count = rng.randint(*BLOCKS) if blocks is None else blocks
    missing = rng.randint(0, math.ceil(MISSING * count))
    graph = _grid(rng, count + missing)
    for _ in range(missing):
        _take_away_a_street(rng, graph)
    for corner in [node for node, arms in graph.items() if len(arms) == 2]:
        if rng.random() < BEVELLED:
            _bevel(rng, graph, corner)
    return _layout(rng, name, graph)


def _grid(rng: random.Random, blocks: int) -> Graph:
    """A rectangle cut into blocks."""
    area, aspect = blocks * rng.uniform(*BLOCK_AREA), rng.uniform(*ASPECT)
    streets: list[tuple[Point, Point]] = []
    while len(streets) != blocks + 3:
        streets = _cut_up((math.sqrt(area * aspect), math.sqrt(area / aspect)), rng, blocks)
        area *= 1.1  # for the next try, should all blocks have become too small to cut
    graph: Graph = {end: [] for street in streets for end in street}
    for first, last in streets:
        on_it = (node for node in graph if all(a <= x <= b for a, x, b in zip(first, node, last, strict=True)))
        for a, b in pairwise(sorted(on_it)):
            graph[a].append(b)
            graph[b].append(a)
    return graph


def _cut_up(size: Point, rng: random.Random, blocks: int) -> list[tuple[Point, Point]]:
    """The sides of a rectangle and streets that cut it into so many blocks, or fewer if none can be cut any more."""
    (x, y), origin = size, (0.0, 0.0)
    streets = [(origin, (x, 0.0)), (origin, (0.0, y)), ((x, 0.0), size), ((0.0, y), size)]
    to_cut = [(origin, size)]
    while to_cut and len(streets) < blocks + 3:
        areas = [(high[0] - low[0]) * (high[1] - low[1]) for low, high in to_cut]
        low, high = to_cut.pop(rng.choices(range(len(to_cut)), areas)[0])
        street = _cut(low, high, rng, streets)
        if street is not None:
            streets.append(street)
            to_cut += [(low, street[1]), (street[0], high)]
    return streets


def _cut(low: Point, high: Point, rng: random.Random, streets: list[tuple[Point, Point]]) -> tuple[Point, Point] | None:
    """A street across a block that keeps its distance from others, or None where chance finds none."""
    for _ in range(8):
        axis = rng.choices((0, 1), [high[0] - low[0], high[1] - low[1]])[0]
        at = rng.uniform(low[axis], high[axis])
        sides = low[1 - axis], high[1 - axis]
        ends = [end[axis] for street in streets for end in street if end[1 - axis] in sides]  # the block's corners too
        nearest = min(ends, key=lambda end: abs(end - at))
        if abs(nearest - at) < SPACING or rng.random() < CROSSINGS:
            at = nearest
        if low[axis] < at < high[axis] and all(end == at or abs(end - at) >= SPACING for end in ends):
            return ((at, low[1]), (at, high[1])) if axis == 0 else ((low[0], at), (high[0], at))
    return None


def _take_away_a_street(rng: random.Random, graph: Graph) -> None:
    """Take away all between two junctions that are joined by another way too."""
    streets = [(a, b) for a, arms in graph.items() for b in arms]
    rng.shuffle(streets)
    for street in streets:
        way = _between_junctions(graph, *street)
        if way[0] != way[-1] and _joined_otherwise(graph, way):
            break
    else:
        return
    for a, b in pairwise(way):
        graph[a].remove(b)
        graph[b].remove(a)
    for node in way:
        arms = graph[node]
        if not arms:
            del graph[node]
        elif len(arms) == 2 and any(a == b for a, b in zip(*arms, strict=True)):  # straight on: no node any more
            del graph[node]
            for a, b in (arms, arms[::-1]):
                graph[a][graph[a].index(node)] = b


def _between_junctions(graph: Graph, a: Point, b: Point) -> list[Point]:
    """The nodes from junction to junction around the street from ``a`` to ``b``; between them lie corners."""
    way = [a, b]
    for _ in range(2):
        while len(graph[way[-1]]) == 2:
            way += [node for node in graph[way[-1]] if node != way[-2]]
        way.reverse()
    return way


def _joined_otherwise(graph: Graph, way: list[Point]) -> bool:
    """Whether the ends of a way are joined by another."""
    reached = [way[0]]
    seen = set(way) - {way[-1]}
    for node in reached:
        following = [other for other in graph[node] if other not in seen and {node, other} != {way[0], way[-1]}]
        reached += following
        seen.update(following)
    return way[-1] in seen


def _bevel(rng: random.Random, graph: Graph, corner: Point) -> None:
    """Make two blunt corners of one."""
    arms = graph[corner]
    lengths = [math.dist(corner, arm) for arm in arms]
    if min(lengths) < BEVEL_STREET:
        return
    shares = [rng.uniform(BEVEL[0], min(BEVEL[1], CORNER_SHARE * length)) / length for length in lengths]
    x, y = corner
    del graph[corner]
    ends = [(x + share * (a - x), y + share * (b - y)) for share, (a, b) in zip(shares, arms, strict=True)]
    for end, other, arm in zip(ends, ends[::-1], arms, strict=True):
        graph[end] = [arm, other]
        graph[arm][graph[arm].index(corner)] = end


def _layout(rng: random.Random, name: str, graph: Graph) -> Layout:
    """The graph turned, with radii."""
    turned = rng.uniform(0, math.tau)
    cos, sin = math.cos(turned), math.sin(turned)
    names = {node: f"n{k}" for k, node in enumerate(graph)}
    nodes = {}
    for (x, y), arms in graph.items():
        longest = CORNER_SHARE * min(math.dist((x, y), arm) for arm in arms)
        radius = rng.uniform(*JUNCTION_RADIUS if len(arms) > 2 else (CORNER_RADIUS[0], min(CORNER_RADIUS[1], longest)))
        nodes[names[x, y]] = Node(round(x * cos - y * sin, 2), round(x * sin + y * cos, 2), round(radius, 1))
    streets = tuple((names[a], names[b]) for a, arms in graph.items() for b in arms if names[a] < names[b])
    return Layout(name, round(rng.uniform(*LANE_WIDTH), 2), nodes, streets)
