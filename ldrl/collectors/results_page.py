"""The page of results: the paper's tables with ours beside them, and where ours fall short."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from statistics import mean
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
FAMILIES = {family: f"gs-hih-{family}" for family in ("paraphrase", "ambiguity", "noise", "rambling")}
NAMES = {cell: name for table in (FULL, EVERY, MODELS) for name, cell in table.items()} | {
    "gs-hih": "Hih, gs",
    "gs-hih-unseen": "Hih, gs",
    **{cell: f"{model}, misleading instructions" for model, cell in MISLEADING.items()},
    **{cell: f"Hih, {family}" for family, cell in FAMILIES.items()},
}
INTRODUCTION = """\
# Results

The tables of Roh et al. 2019 with ours beside them. `python recipes/reproduce_paper.py` writes this page from
`results.json` beside it and from the finished cells of `runs/paper`; a change by hand is lost.

- *success*, the paper's measure: no collision, and every point of the path within 10 m of the track. *strict success*:
  also never off the road, never in an oncoming lane, and `finish` declared within 15 m of the path's end. *paper*: what
  it reports as success, on routes of its own in CARLA; train is Town 1, test Town 2. Where the map does not allow what
  is asked and the car should stop, success also takes that it stands within 10 m of the path's end.
- Trained in Town 1 and seven random towns. Episodes are all routes of our planner in Town 1 and Town 2, each driven
  once, said in sentences without a phrase of the training's templates.
- A figure is the mean over the seeds, in brackets the least and the largest of them. "-" is not measured yet, or not
  reported by the paper."""
DEPARTURES = """\
These concern the tables above; [the design](design.md#departures-from-the-paper) has those of the whole system.

1. **World.** Flat towns drawn from their lanes instead of CARLA. On rgb the figures compare worlds as well as agents:
   CARLA's images are other ones than ours, and nobody has driven either agent in the other's.
2. **Episodes** are all routes of our planner, so that nobody chooses among them, not the paper's 159 and 142; `all`
   mixes the types in another proportion.
3. **Training towns.** Town 1 and seven random towns, which have what Town 1 lacks: junctions of four streets. Town 2,
   as in the paper, and the unseen towns are in no training; but the seven were chosen, for the width of their lanes,
   after strict success in Town 2 and what was lost in unseen towns had shown that the width matters.
4. **Sentences** come from our own templates on the paper's scale, as the paper's collected ones are not public;
   evaluation says held-out ones only. Training hears none of these and none of the family of ambiguity word for word,
   but for single bare words, and its table of mishearings shares none with that of noise. But some of its phrasings
   were written to help where readings of held-out sentences had failed, and letters are misspelt at random in both.
   What the reader knows of words and what training does to sentences was chosen by how much of each family is read
   right, without a look at a sentence of them: *kept* may be a little better than it would be in a fifth family.
5. **Sizes and schedule.** Networks of 1.2 million parameters with normalised convolutions, trained on CPU cores in the
   times above.
6. **The reader is learned first**, from sentences alone, and its encoder then stays as it is: sentences are cheap,
   images are not. It reads both ways.
7. **Models share what they can**, so that a table takes minutes: the low level is that of Hih where the paper's differ
   in the high level only, and the high level of H0, Hi, NMC and the single policies starts from Hih's. NMC learns to
   read anew from the words' encoder, without the attention, in 3,000 batches for Hih's 12,000. They are trained for
   less long than Hih with its 2,400 batches: for 1,200, the single policies for 250 of whole drives. Hihg has Hih's
   high level and trains 800 batches of the low level from Hih's with its 1,600.
8. **Training on rgb starts from the agent on gs**: the same road in other colours, which saves most of it: 1,600
   further batches of the low level and 1,200 of the high level. **ps is not trained on**: agents trained on gs drive on
   it as they are. H0's high level sees no image, so that on rgb and ps it is that of gs.
9. **Colours are seen relative to the road in front of the car and to the image's contrast, and looks are drawn for
   every image of the training**; the table of looks shows what the latter is worth. All its rows have the former.
10. **The segmenter of ps** is a small DeepLabv3+ trained on random towns of ours, the paper's on photographs. It is
    trained once, in 36 minutes that are not among those below, and serves all seeds.
11. **Views beside the path** are labelled by asking the expert there, where the paper shifts the steering of turned
    cameras by a constant: recovery is learned exactly.
12. **Recurrent states** run on through a sub-task, where the paper re-runs the last 10 frames at every step, which gave
    an early agent nothing. But single policies that see 10 frames do better than those of Table 3 here, see
    [the design](design.md#what-the-baselines-lack).
13. **Misleading instructions** are a quarter of those in 1,200 further batches, which start from the agent that knows
    none; the paper says no share. Where the car should stop, success is asked for more than in the other tables."""
MODELS_NOTE = """\
Single policies never declare `finish`, so none of their successes is strict. Table 3 gives 0.960 for the paper's Hih on
doubles in Town 2 and Table 2 gives 0.986, which stands here. What the models that should fail do fail at is in
[the design](design.md#what-the-baselines-lack)."""

LOOKS_NOTE = """\
The paper's agent falls in a town that looks otherwise, from 0.880 to 0.613. Ours hardly does by day, whatever it is
trained on, as it starts from an agent on gs and sees colours relative to the road. Looks drawn in training pay at
night, in strict success."""


def results_page(results: Results, cells: Sequence[str], segmenter: Mapping[str, Any]) -> str:
    """The page, in Markdown.

    Args:
        results: whatever is measured.
        cells: names of all cells, in the order of the table of times.
        segmenter: the report of the road segmenter's training.
    """
    parts = [
        INTRODUCTION,
        f"Seeds: {', '.join(map(str, results.seeds)) or 'none yet'}.",
        "## Where ours fall short",
        *_shortfalls(results, cells, segmenter),
        "## What should be reached",
        _targets(results, segmenter),
        "## Input modalities (the paper's Table 2)",
        _table(results, "model", FULL, TYPES),
        "## Models (Table 3), on gs",
        _table(results, "model", MODELS, TYPES),
        MODELS_NOTE,
        "## All hierarchical models over all modalities (Table A3)",
        _table(results, "model", EVERY, ("all",)),
        "## Misleading instructions only, on gs",
        _table(results, "model", MISLEADING | POSSIBLE, ("single", "double", "all")),
        "## Families of sentences, Hih on gs",
        _families(results),
        "## Unseen towns, Hih on gs",
        _unseen(results),
        "## Looks in training, Hih on rgb",
        _table(results, "looks", LOOKS, TYPES),
        LOOKS_NOTE,
        "## Road segmenter of ps",
        _segmenter(segmenter),
        "## Time",
        *_time(results, cells),
        "## Departures from the paper",
        DEPARTURES,
    ]
    return "\n\n".join(parts) + "\n"


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
        f"- time, seed {seed}: {_busy(timed) / 60:.0f} minutes by the clock, to reach is {MOST_MINUTES} for all cells."
        for seed, timed in _by_seed(results, cells)
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
    table = markdown_table(lines, left=1)
    return (
        f"{table}\n\nThe same routes in other sentences; noise, and rambling mostly, are the clean sentence of the "
        "route with something done to it. *kept* is the rate of success over that on clean sentences. What is misread, "
        "and what remedies gave, is in [the design](design.md#language)."
    )


def _unseen(results: Results) -> str:
    lines: list[tuple[str, ...]] = [("type", "episodes", "success", "strict success")]
    for type_ in (*TYPES, T_ONLY, FOUR_WAY, "worst town"):
        episodes = results.values("gs-hih-unseen", "unseen", type_, "episodes")
        rates = [results.values("gs-hih-unseen", "unseen", type_, m) for m in ("success", "strict_success")]
        lines.append((type_, f"{mean(episodes):.0f}" if episodes else "-", *map(_spread, rates)))
    table = markdown_table(lines, left=1)
    return (
        "Random towns, number 0 to 49 unless the command says otherwise, in which no agent was trained; two routes of "
        f"every keyword in each.\n\n{table}"
    )


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


def _segmenter(report: Mapping[str, Any]) -> str:
    trained = report["details"]["training"]
    return f"Intersection over union of the road. Trained: {trained}.\n\n{segmenter_table(report['rows'])}"


def _time(results: Results, cells: Sequence[str]) -> Iterator[str]:
    known = [result for result in results if result.cell in cells]
    for seed, timed in _by_seed(results, cells):
        clock, added = (f"{seconds / 60:.0f}" for seconds in (_busy(timed), sum(result.seconds for result in timed)))
        yield f"Seed {seed}: {len(timed)} of {len(cells)} cells took {clock} minutes by the clock, {added} added up."
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
