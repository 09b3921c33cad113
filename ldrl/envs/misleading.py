"""Misleading instructions: directions that the map does not allow, and the safe drive as the right one."""

from __future__ import annotations

import random
from dataclasses import replace

from ldrl.envs import vehicle
from ldrl.envs.episodes import END_BEHIND_JUNCTION, MOST_ROUTES, START_BEFORE_JUNCTION, Episode, episode_along
from ldrl.language import KEYWORDS, SAFE_KEYWORDS, Keyword, Sentences
from ldrl.towns import Route, Town, UnrealisableError, plan_routes

__all__ = ["misleading_episodes", "misleading_routes"]

STOP_BEFORE_JUNCTION = vehicle.LENGTH / 2
"""A car that stops stands with its front at the junction, its origin this far before it, m."""
STOPPING_DISTANCE = 8.0
"""A car at the start of an episode rolls 7.6 m; starts leave it so much way to stand before the junction, m."""


def misleading_routes(town: Town, keyword: Keyword | str) -> list[Route]:
    """The safe route from every approach to a junction from which a town does not allow what a keyword asks for.

    It goes straight on instead of an impossible turn, and ends before a junction without the straight on that is asked
    for (paper's safe behaviour).

    Args:
        town: the town.
        keyword: a single or a double.

    Returns:
        In the order of :meth:`Town.approaches`; none where the town allows it everywhere.

    Raises:
        ValueError: the keyword is an ordinal: it waits for its street instead.

    Examples:
        >>> town = Town.load("town2")
        >>> {route.manoeuvres for route in misleading_routes(town, "left")}
        {(<SubTask.STRAIGHT: 2>,)}
        >>> {route.stops for route in misleading_routes(town, "straight")}
        {True}
    """
    name = Keyword.parse(keyword).name
    if name not in SAFE_KEYWORDS:
        raise ValueError(f"{name!r} is an ordinal and never misleads; use one of {', '.join(map(repr, SAFE_KEYWORDS))}")
    allowed = {route.lanes[0] for route in _routes(town, KEYWORDS[name])}
    return [route for route in _routes(town, SAFE_KEYWORDS[name]) if route.lanes[0] not in allowed]


def _routes(town: Town, keyword: Keyword) -> list[Route]:
    try:
        return plan_routes(town, keyword)
    except UnrealisableError:
        return []


def misleading_episodes(town: Town, seed: int = 0, most_routes: int = MOST_ROUTES) -> list[Episode]:
    """An episode for every misleading route of every single and double, said in held-out sentences.

    Of a keyword with more than ``most_routes`` routes, so many are drawn. Starts and ends are those of the built-in
    episodes, but where the car should stop: that path ends with the car's front at the junction, and where it is the
    first junction, no start is so near that the car could not roll to a stop before it.

    Args:
        town: the town.
        seed: of the starts, ends, sentences and the routes where they are drawn.
        most_routes: of one keyword.

    Examples:
        >>> episode = misleading_episodes(Town.load("town2"))[0]
        >>> episode.id, episode.keyword, episode.stop
        ('town2-misleading-left-0', 'left', False)
    """
    rng = random.Random(f"{town.name}-misleading-{seed}")
    sentences = Sentences("heldout")
    episodes = []
    for keyword in SAFE_KEYWORDS.values():
        routes = dict(enumerate(misleading_routes(town, keyword)))
        if len(routes) > most_routes:
            routes = {k: routes[k] for k in sorted(rng.sample(sorted(routes), most_routes))}
        for k, route in routes.items():
            name = f"misleading-{keyword.name.replace(',', '-')}-{k}"
            instruction = sentences.sample(keyword, rng)
            episodes.append(episode_along(_shortened(route, rng), name, keyword, instruction))
    return episodes


def _shortened(route: Route, rng: random.Random) -> Route:
    """The part of a route that is driven."""
    first, last = (float(route.town.lane_length[route.lanes[k]]) for k in (0, -1))
    nearest = STOP_BEFORE_JUNCTION + STOPPING_DISTANCE if route.stops and not route.manoeuvres else 0.0
    start = first - min(rng.uniform(nearest, START_BEFORE_JUNCTION), first)
    end = max(last - STOP_BEFORE_JUNCTION, 0.0) if route.stops else min(rng.uniform(*END_BEHIND_JUNCTION), last)
    return replace(route, start=start, end=end)
