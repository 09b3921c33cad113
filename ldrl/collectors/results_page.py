"""The page of results: the paper's tables with ours beside them, and where ours fall short, put into a page of text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import mean
from string import Template
from typing import Any

from ldrl.collectors.paper import LEAST_IOU, MOST_MINUTES, SUCCESS, TARGETS, Target
from ldrl.collectors.report import markdown_table
from ldrl.collectors.results import FOUR_WAY, T_ONLY, Result, Results

__all__ = ["results_page", "segmenter_table"]

TOWNS = {"town1": "Town 1", "town2": "Town 2", "unseen": "unseen towns"}
TYPES = ("single", "double", "ordinal", "all")
FULL = {f"Hih, {modality}": f"{modality}-hih" for modality in ("rgb", "gs", "ps")}
MODELS = {
    "single policy": "gs-single",
    "single policy with history": "gs-single-history",
    "NMC": "gs-nmc",
    "H0": "gs-h0",
    "Hi": "gs-hi",
    "Hih": "gs-hih",
    "Hihg": "gs-hihg",
}
SEEDS = 3
"""A target is for the mean of so many."""
BASELINES = ("gs-single", "gs-single-history", "gs-nmc")
EVERY = {
    f"{model}, {modality}": f"{modality}-{model.lower()}"
    for model in ("H0", "Hi", "Hih")
    for modality in ("rgb", "gs", "ps")
}
MISLEADING = {model: f"gs-{model.lower()}-misleading" for model in ("H0", "Hi", "Hih")}
POSSIBLE = {"Hih, on possible instructions": "gs-hih-misleading-builtin"}
LOOKS = {
    "drawn for every image": "rgb-hih",
    "one: Town 1's own in clear weather": "rgb-hih-clear",
    "drawn for every image; driven at night": "rgb-hih-night",
    "one; driven at night": "rgb-hih-clear-night",
}
BEYOND = ("rgb-low-clear", *(cell for cell in LOOKS.values() if cell != "rgb-hih"), "gs-hih-unseen")
"""Cells of no table of the paper: looks and unseen towns."""
FAMILIES = {family: f"gs-hih-{family}" for family in ("paraphrase", "ambiguity", "noise", "rambling")}
NAMES = {cell: name for table in (FULL, EVERY, MODELS) for name, cell in table.items()} | {
    "gs-hih": "Hih, gs",
    "gs-hih-unseen": "Hih, gs",
    **{cell: f"{model}, misleading instructions" for model, cell in MISLEADING.items()},
    **{cell: f"Hih, {family}" for family, cell in FAMILIES.items()},
}


def results_page(results: Results, cells: Sequence[str], segmenter: Mapping[str, Any]) -> str:
    """The page, in Markdown.

    Args:
        results: whatever is measured.
        cells: names of all cells, in the order of the table of times.
        segmenter: the report of the road segmenter's training.
    """
    filled = {
        "seeds": ", ".join(map(str, results.seeds)) or "none yet",
        "shortfalls": "\n\n".join(_shortfalls(results, cells, segmenter)),
        "targets": _targets(results, segmenter),
        "modalities": _table(results, "model", FULL, TYPES),
        "models": _table(results, "model", MODELS, TYPES),
        "hierarchical": _table(results, "model", EVERY, ("all",)),
        "misleading": _table(results, "model", MISLEADING | POSSIBLE, ("single", "double", "all")),
        "families": _families(results),
        "unseen": _unseen(results),
        "looks": _table(results, "looks", LOOKS, TYPES),
        "segmenter_training": segmenter["details"]["training"],
        "segmenter": segmenter_table(segmenter["rows"]),
        "time": "\n\n".join(_time(results, cells)),
    }
    page = Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
    return Template(page).substitute(filled)


def _spread(values: Sequence[float], digits: int = 3) -> str:
    if not values:
        return "-"
    spread = f" ({min(values):.{digits}f} to {max(values):.{digits}f})" if len(values) > 1 else ""
    return f"{mean(values):.{digits}f}{spread}"


def _table(results: Results, what: str, rows: Mapping[str, str], types: Sequence[str]) -> str:
    """A row for each cell and type: success, strict success and the paper's success, both towns side by side."""
    columns = ("success", "strict success", "paper")
    lines = [(what, "type", *(f"{TOWNS[town]} {column}" for town in ("town1", "town2") for column in columns), "seeds")]
    for name, cell in rows.items():
        theirs = SUCCESS.get(cell.removesuffix("-clear"), {})
        for type_ in types:
            line = [name, type_]
            for town in ("town1", "town2"):
                line += [_spread(results.values(cell, town, type_, m)) for m in ("success", "strict_success")]
                line.append(_spread([theirs[town][type_]] if theirs else []))
            lines.append((*line, str(len(results.of(cell)))))
    return markdown_table(lines, left=2)


def _described(target: Target) -> tuple[str, str, str, str]:
    measure = {"strict_success": "strict success", "kept": "success kept"}.get(target.measure, target.measure)
    return NAMES[target.cell], TOWNS[target.town], target.type, measure


def _targets(results: Results, segmenter: Mapping[str, Any]) -> str:
    lines = [("model", "town", "type", "measure", "ours", "at least", "reached", "seeds")]
    for target in TARGETS:
        values = results.values(*target[:4])
        reached = "-" if not values else "yes" if round(mean(values), 3) >= target.least else "no"
        if 0 < len(values) < SEEDS:
            reached += " so far"
        lines.append((*_described(target), _spread(values), f"{target.least:.3f}", reached, str(len(values))))
    for town in ("town1", "town2"):
        worst = min(row["iou"] for row in segmenter["rows"] if row["town"] == town)
        reached = "yes" if worst >= LEAST_IOU else "no"
        lines.append(
            ("road segmenter", TOWNS[town], "worst look", "IoU", f"{worst:.3f}", f"{LEAST_IOU:.3f}", reached, "-")
        )
    return markdown_table(lines, left=4)


def _shortfalls(results: Results, cells: Sequence[str], segmenter: Mapping[str, Any]) -> Iterator[str]:
    missed = [
        f"- {', '.join(_described(target))}: {_spread(values)}, to reach is {target.least:.3f}."
        for target in TARGETS
        if (values := results.values(*target[:4])) and round(mean(values), 3) < target.least
    ]
    missed += [
        f"- road segmenter, {TOWNS[row['town']]}, {row['look']}: {row['iou']:.3f}, to reach is {LEAST_IOU:.3f}."
        for row in segmenter["rows"]
        if row["iou"] < LEAST_IOU
    ]
    missed += [
        f"- time, seed {seed}: {_busy(timed) / 60:.0f} minutes by the clock for the paper's tables, to reach is "
        f"{MOST_MINUTES}."
        for seed, timed in _by_seed(results, [cell for cell in cells if cell not in BEYOND])
        if _busy(timed) > 60 * MOST_MINUTES
    ]
    below: dict[bool, list[str]] = {True: [], False: []}
    above = []
    for cell, towns in SUCCESS.items():
        for town, types in towns.items():
            for type_, theirs in types.items():
                values = results.values(cell, town, type_, "success")
                line = f"- {NAMES[cell]}, {TOWNS[town]}, {type_}: {_spread(values)}, the paper's {theirs:.3f}."
                if values and round(mean(values), 3) < theirs:
                    below[cell in BASELINES].append(line)
                elif values and cell in BASELINES and type_ == "all":
                    above.append(line)
    yield "Below what this project should reach:"
    yield "\n".join(missed or ["- nothing that is measured"])
    yield "Below the paper's success:"
    yield "\n".join(below[False] or ["- nothing that is measured"])
    yield "Baselines below the paper's, which are there to fail:"
    yield "\n".join(below[True] or ["- none that is measured"])
    yield "Baselines that do better than the paper's; [why](design.md#what-the-baselines-lack):"
    yield "\n".join(above or ["- none that is measured"])


def _families(results: Results) -> str:
    lines = [
        ("sentences", *(f"{TOWNS[t]} {m}" for t in ("town1", "town2") for m in ("success", "strict success", "kept")))
    ]
    for family, cell in ({"clean": "gs-hih"} | FAMILIES).items():
        figures = []
        for town in ("town1", "town2"):
            figures += [_spread(results.values(cell, town, "all", m)) for m in ("success", "strict_success")]
            figures.append(_spread(results.values(cell, town, "all", "kept")) if cell != "gs-hih" else "-")
        lines.append((family, *figures))
    return markdown_table(lines, left=1)


def _unseen(results: Results) -> str:
    lines: list[tuple[str, ...]] = [("type", "episodes", "success", "strict success")]
    for type_ in (*TYPES, T_ONLY, FOUR_WAY, "worst town"):
        episodes = results.values("gs-hih-unseen", "unseen", type_, "episodes")
        rates = [results.values("gs-hih-unseen", "unseen", type_, m) for m in ("success", "strict_success")]
        lines.append((type_, f"{mean(episodes):.0f}" if episodes else "-", *map(_spread, rates)))
    return markdown_table(lines, left=1)


def segmenter_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """What a road segmenter reaches in each look, both towns side by side, in Markdown.

    Args:
        rows: of the ``report.json`` that ``recipes/train_segmenter.py`` writes.
    """
    found = {(row["town"], row["look"]): row for row in rows}
    lines = [("look", *(f"{TOWNS[town]} {what}" for town in ("town1", "town2") for what in ("IoU", "worst view")))]
    for look in dict.fromkeys(look for _, look in found):
        both = (found[town, look] for town in ("town1", "town2"))
        lines.append((look, *(f"{row[name]:.3f}" for row in both for name in ("iou", "worst_view"))))
    return markdown_table(lines, left=1)


def _time(results: Results, cells: Sequence[str]) -> Iterator[str]:
    known = [result for result in results if result.cell in cells]
    paper = [cell for cell in cells if cell not in BEYOND]
    for what, some in (("the paper's tables", paper), ("looks and unseen towns", [c for c in cells if c in BEYOND])):
        for seed, timed in _by_seed(results, some):
            clock, added = (f"{s / 60:.0f}" for s in (_busy(timed), sum(result.seconds for result in timed)))
            took = f"{len(timed)} of {len(some)} cells took {clock} minutes by the clock, {added} added up"
            yield f"Seed {seed}, {what}: {took}."
    for what in ("hardware", "versions"):
        yield f"{what.capitalize()}: {'; '.join(sorted({getattr(result, what) for result in known})) or '-'}."
    lines, commands = [("cell", "minutes", "seeds")], []
    for cell in cells:
        made = results.of(cell)
        lines.append((cell, _spread([result.seconds / 60 for result in made], 1), str(len(made))))
        commands += [result.command for result in made]
    yield markdown_table(lines, left=1)
    yield "The commands:"
    yield "\n".join(("```", *commands, "```"))


def _by_seed(results: Results, cells: Sequence[str]) -> Iterator[tuple[int, list[Result]]]:
    """The results of some cells, for each seed."""
    for seed in results.seeds:
        yield seed, [result for result in results if result.seed == seed and result.cell in cells]


def _busy(results: Sequence[Result]) -> float:
    """Seconds in which at least one of them was under way."""
    total, until = 0.0, 0.0
    for result in sorted(results, key=lambda result: result.began):
        total += max(0.0, result.began + result.seconds - max(until, result.began))
        until = max(until, result.began + result.seconds)
    return total
