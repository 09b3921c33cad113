"""What many trainings and evaluations came to, a short record of each: one file in which several runs add up."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

from ldrl.collectors.report import replacing
from ldrl.language import KEYWORDS
from ldrl.towns import random_layout

__all__ = ["MADE", "REPORT", "Rates", "Result", "Results", "measure", "read_cells"]

REPORT, MADE = "report.json", "made.json"
"""Files of a finished cell: its outcomes, see :func:`~ldrl.collectors.report.to_json`, and how it was made."""
FOUR_WAY, T_ONLY = "towns with four-way junctions", "towns with T-junctions only"
MEASURES = ("success", "strict_success")

Rates = dict[str, dict[str, dict[str, float]]]
"""By town, then by type of keyword or ``"all"``: the number of ``"episodes"``, ``"success"``, ``"strict_success"``."""


@dataclass(frozen=True)
class Result:
    """A finished cell: one training with its evaluation, or one evaluation.

    Args:
        cell: its name.
        seed: of the training.
        command: what made it.
        began: seconds since 1970.
        seconds: how long it took.
        hardware: and how many cells ran side by side.
        versions: of Python and torch.
        rates: what was measured; random towns together are the town ``"unseen"``.
    """

    cell: str
    seed: int
    command: str
    began: float
    seconds: float
    hardware: str
    versions: str
    rates: Rates


def measure(records: Iterable[Mapping[str, Any]]) -> Rates:
    """Rates of episodes.

    Args:
        records: those of a report's ``"episodes"``.

    Returns:
        Rates rounded to 6 digits. The types of ``"unseen"`` are also towns with four-way junctions, those without, and
        the town with the fewest successes.
    """
    groups: dict[str, dict[str, list[Mapping[str, Any]]]] = defaultdict(lambda: defaultdict(list))
    random_towns: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
    for record in records:
        unseen = record["town"].startswith("random-")
        names = [KEYWORDS[record["keyword"]].type, "all"]
        if unseen:
            names.append(FOUR_WAY if _has_four_way(record["town"]) else T_ONLY)
            random_towns[record["town"]].append(record)
        for name in names:
            groups["unseen" if unseen else record["town"]][name].append(record)
    if random_towns:
        groups["unseen"]["worst town"] = min(random_towns.values(), key=lambda some: _rate(some, "success"))
    return {
        town: {
            name: {"episodes": len(some)} | {measure: _rate(some, measure) for measure in MEASURES}
            for name, some in types.items()
        }
        for town, types in groups.items()
    }


def _rate(records: Sequence[Mapping[str, Any]], measure: str) -> float:
    return round(sum(record[measure] for record in records) / len(records), 6)


@cache
def _has_four_way(town: str) -> bool:
    layout = random_layout(*map(int, town.removeprefix("random-").split("-")))
    return max(Counter(end for street in layout.streets for end in street).values()) > 3


def read_cells(folder: str | Path) -> list[Result]:
    """The finished cells in ``<folder>/seed<k>/<cell>/``.

    Raises:
        ValueError: a cell's files are broken.
    """
    found = []
    for made in sorted(Path(folder).glob(f"seed*/*/{MADE}")):
        report, seed = made.with_name(REPORT), made.parent.parent.name.removeprefix("seed")
        if report.is_file() and seed.isdecimal():
            try:
                about = json.loads(made.read_text(encoding="utf-8"))
                about = {field.name: about[field.name] for field in fields(Result) if field.name in about}
                rates = measure(json.loads(report.read_text(encoding="utf-8"))["episodes"])
                found.append(Result(made.parent.name, int(seed), **about, rates=rates))
            except (ValueError, TypeError, KeyError) as error:
                raise ValueError(f"{made.parent} is no finished cell ({error!r}); delete it and run again") from None
    return found


class Results:
    """Results by cell and seed.

    Args:
        results: of two of the same cell and seed the later one counts.

    Examples:
        >>> rates = {"town1": {"all": {"episodes": 4, "success": 0.75, "strict_success": 0.5}}}
        >>> results = Results(Result("gs-hih", seed, "", 0, 0, "", "", rates) for seed in (0, 1))
        >>> results.values("gs-hih", "town1", "all", "success")
        [0.75, 0.75]
    """

    def __init__(self, results: Iterable[Result] = ()) -> None:
        self._results: dict[tuple[str, int], Result] = {}
        for result in results:
            known = self._results.get((result.cell, result.seed))
            if known is None or known.began <= result.began:
                self._results[result.cell, result.seed] = result

    def __iter__(self) -> Iterator[Result]:
        return iter(self._results.values())

    @property
    def seeds(self) -> list[int]:
        """Every seed of which there is something."""
        return sorted({seed for _, seed in self._results})

    def of(self, cell: str) -> list[Result]:
        """Those of one cell, by seed."""
        return sorted((result for result in self if result.cell == cell), key=lambda result: result.seed)

    def values(self, cell: str, town: str, type_: str, measure: str) -> list[float]:
        """A rate, once for each seed that has it.

        Args:
            cell: its name.
            town: ``"town1"``, ``"town2"`` or ``"unseen"``.
            type_: of keyword, or ``"all"``.
            measure: ``"success"``, ``"strict_success"``, or ``"kept"``: success over that of the cell whose name is
                this one's without its last word.
        """
        if measure == "kept":
            clean = {result.seed: result.rates for result in self.of(cell.rpartition("-")[0])}
            both = [(result.rates, clean[result.seed]) for result in self.of(cell) if result.seed in clean]
            pairs = [tuple(rates.get(town, {}).get(type_, {}).get("success") for rates in pair) for pair in both]
            return [said / before for said, before in pairs if said is not None and before]
        found = (result.rates.get(town, {}).get(type_, {}).get(measure) for result in self.of(cell))
        return [value for value in found if value is not None]

    def save(self, path: str | Path) -> None:
        """Write them as JSON, a line each, the file whole or not at all."""
        ordered = sorted(self, key=lambda result: (result.seed, result.cell))
        lines = ",\n".join(json.dumps(asdict(result)) for result in ordered)
        with replacing(path) as file:
            file.write_text(f"[\n{lines}\n]\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> Results:
        """Read what :meth:`save` wrote; nothing where there is no file.

        Raises:
            ValueError: the file is no such thing.
        """
        if not Path(path).is_file():
            return cls()
        try:
            return cls(Result(**record) for record in json.loads(Path(path).read_text(encoding="utf-8")))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} holds no results ({error}); take it from git again, or delete it") from None
