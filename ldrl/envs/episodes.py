"""Episodes: where a car starts, what it is told, and the path that it should take."""

from __future__ import annotations

import json
import random
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from ldrl.language import KEYWORDS, Families, Family, Keyword, Sentences, Split, Tokenizer
from ldrl.towns import Route, Town, UnrealisableError, match_route, plan_routes
from ldrl.towns.opendrive import load_network

__all__ = ["Episode", "builtin_episodes", "load_episodes", "save_episodes"]

START_BEFORE_JUNCTION = 35.0
"""Starts lie up to this far before the first junction (paper's evaluation), m."""
END_BEHIND_JUNCTION = (5.0, 10.0)
"""Paths end this far past the exit of the last manoeuvre, m."""
MOST_ROUTES = 40
"""Built-in episodes of one keyword in one town, at most: a large town has thousands of routes."""
FIELDS = ("id", "town", "keyword", "instruction", "start", "path")


@dataclass(frozen=True)
class Episode:
    """One drive, as a line of an episode file says it.

    Args:
        id: any string; reports return it unchanged.
        town: name of the town, such as ``"town1"`` or ``"random-7"``; in a file also the path of a ``.xodr`` file.
        keyword: what the instruction means.
        instruction: what the passenger says.
        start: x, y (m) and heading (rad).
        path: points ``(x, y)`` that the car should pass, in order, m.
        stop: whether the car should stand at the path's end; a file says so only where it is true.

    Raises:
        ValueError: a field has the wrong form; the message names it and its value.
    """

    id: str
    town: str
    keyword: str
    instruction: str
    start: tuple[float, float, float]
    path: tuple[tuple[float, float], ...]
    stop: bool = False

    def __post_init__(self) -> None:
        for name in ("id", "town", "keyword", "instruction"):
            if not isinstance(getattr(self, name), str):
                raise ValueError(f"{name} is {getattr(self, name)!r}; make it a string")
        object.__setattr__(self, "keyword", Keyword.parse(self.keyword).name)
        object.__setattr__(self, "start", _numbers("start", self.start, 3))
        if not isinstance(self.path, list | tuple) or not self.path:
            raise ValueError(f"path is {self.path!r}; give at least one point [x, y]")
        path = tuple(_numbers(f"path point {k}", point, 2) for k, point in enumerate(self.path))
        object.__setattr__(self, "path", path)
        if not isinstance(self.stop, bool):
            raise ValueError(f"stop is {self.stop!r}; make it true or false")
        Tokenizer()([self.instruction])

    def route(self, town: Town) -> Route:
        """The route along the path.

        Args:
            town: the episode's town.

        Raises:
            ValueError: the town is another, or the start or the path is off the road.
        """
        if town.name != self.town:
            raise ValueError(f"episode {self.id!r} is set in {self.town!r}, not in {town.name!r}; split them by town")
        try:
            return match_route(town, self.start, self.path)
        except ValueError as error:
            raise ValueError(f"episode {self.id!r}: {error}") from None


def _numbers(name: str, value: object, count: int) -> tuple:
    if not isinstance(value, list | tuple) or len(value) != count or not all(map(_is_finite, value)):
        raise ValueError(f"{name} is {value!r:.200}; give {count} finite numbers")
    return tuple(map(float, value))


def _is_finite(value: object) -> bool:
    # Not bool, which Python takes for a number, and no integer too large for a float.
    return type(value) in (int, float) and -1e300 < value < 1e300  # type: ignore[operator]


def builtin_episodes(
    town: Town, split: Split | Family = "heldout", seed: int = 0, most_routes: int = MOST_ROUTES
) -> list[Episode]:
    """The built-in episodes: the distinct routes of every keyword that the town can realise.

    Of a keyword with more than ``most_routes`` routes, so many are drawn. Each starts up to 35 m before its first
    junction and ends 5 to 10 m past the exit of its last manoeuvre.

    Args:
        town: the town.
        split: which sentences the passengers say; nothing else of the episodes depends on it.
        seed: of the starts, ends, sentences and the routes where they are drawn.
        most_routes: of one keyword.

    Raises:
        ValueError: there is no such split.

    Examples:
        >>> episodes = builtin_episodes(Town.load("town2"))
        >>> episodes[0].id, episodes[0].keyword
        ('town2-left-0', 'left')
    """
    rng = random.Random(f"{town.name}-{seed}")
    heldout = Sentences("heldout")
    train, family = None, None
    if split == "train":
        train = Sentences("train")
    elif split != "heldout":
        family = Families(split)
    others_rng = random.Random(f"{town.name}-{seed}-{split}")
    episodes = []
    for keyword in KEYWORDS.values():
        try:
            routes = dict(enumerate(plan_routes(town, keyword)))
        except UnrealisableError:
            continue
        if len(routes) > most_routes:
            routes = {k: routes[k] for k in sorted(rng.sample(sorted(routes), most_routes))}
        for k, route in routes.items():
            start = rng.uniform(0, min(START_BEFORE_JUNCTION, float(town.lane_length[route.lanes[0]])))
            end = min(rng.uniform(*END_BEHIND_JUNCTION), float(town.lane_length[route.lanes[-1]]))
            name = f"{keyword.name.replace(',', '-').replace(' ', '-')}-{k}"
            driven = replace(route, start=float(town.lane_length[route.lanes[0]]) - start, end=end)
            # Drawn for every split: the starts that follow depend on it.
            instruction = heldout.sample(keyword, rng)
            if train is not None:
                instruction = train.sample(keyword, others_rng)
            if family is not None:
                instruction = family.sample(keyword, others_rng, clean=instruction)
            episodes.append(episode_along(driven, name, keyword, instruction))
    return episodes


def episode_along(route: Route, name: str, keyword: Keyword, instruction: str) -> Episode:
    """The episode that drives a route from its start to its end, ``id`` the town's name and then ``name``."""
    poses = route.poses().tolist()
    return Episode(
        id=f"{route.town.name}-{name}",
        town=route.town.name,
        keyword=keyword.name,
        instruction=instruction,
        start=tuple(round(v, 3) for v in poses[0]),
        path=tuple((round(x, 2), round(y, 2)) for x, y, _ in poses),
        stop=route.stops,
    )


def save_episodes(episodes: Iterable[Episode], path: str | Path) -> None:
    """Write episodes as JSON lines.

    Args:
        episodes: what to write.
        path: the file.
    """
    # What is not said to stop does not, so that a file needs no more fields than it had before there were stops.
    records = ({k: v for k, v in asdict(episode).items() if v is not False} for episode in episodes)
    Path(path).write_text("".join(json.dumps(record) + "\n" for record in records), encoding="utf-8")


def load_episodes(path: str | Path, towns: dict[str, Town] | None = None) -> list[Episode]:
    """Read an episode file.

    Args:
        path: JSON lines, one episode each; blank lines are skipped.
        towns: by name, to check every start and path against; None checks neither these nor the towns' names. Other
            towns are loaded and added here under the name that the episodes give them. One that ends in ``.xodr`` is
            the path of a map, relative to the folder of the episode file or absolute.

    Raises:
        ValueError: the file has no episode, or a line is broken, or its episode does not lie on the roads of its
            town; the message names the file and the line.
        FileNotFoundError: there is no such file.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no episode file {str(path)!r}; give a JSON-lines file or 'builtin'")
    episodes = []
    try:
        text = Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not UTF-8 ({error}); write JSON lines in UTF-8") from None
    for number, line in enumerate(text.split("\n"), start=1):  # not splitlines: it cuts at U+2028 inside a string
        if not line.strip():
            continue
        try:
            episode = _parse(line)
            if towns is not None:
                episode.route(_town(episode.town, towns, Path(path).parent))
        except (ValueError, FileNotFoundError) as error:
            raise ValueError(f"{path}, line {number}: {error}") from None
        episodes.append(episode)
    if not episodes:
        raise ValueError(f"{path} has no episode; write one JSON object with {', '.join(FIELDS)} per line")
    return episodes


def _parse(line: str) -> Episode:
    try:
        record = json.loads(line)
    except json.JSONDecodeError as error:
        raise ValueError(f"not JSON ({error}); write one object with {', '.join(FIELDS)}") from None
    if not isinstance(record, dict):
        raise ValueError(f"{line[:80]!r} is no object; write one with {', '.join(FIELDS)}")
    missing = [name for name in FIELDS if name not in record]
    if missing:
        raise ValueError(f"{', '.join(missing)} missing; an episode has {', '.join(FIELDS)}")
    return Episode(**{name: record[name] for name in FIELDS}, stop=record.get("stop", False))


def _town(name: str, towns: dict[str, Town], folder: Path) -> Town:
    """The town that an episode names, loaded when it is first named."""
    if name not in towns:
        towns[name] = Town(name, load_network(folder / name)) if name.endswith(".xodr") else Town.load(name)
    return towns[name]
