"""Reports of an evaluation: a Markdown table beside the paper's figures, and a JSON file with every episode."""

from __future__ import annotations

import json
import math
import re
import secrets
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ldrl.collectors.evaluation import FINISH_NEAR, NEAR, Outcome
from ldrl.collectors.paper import Success
from ldrl.language import KEYWORDS

__all__ = [
    "check_whole_numbers",
    "check_writable",
    "keyword_table",
    "markdown_table",
    "replacing",
    "summarise",
    "table",
    "to_json",
    "to_markdown",
    "write_json",
]

NOTES = (
    f"- success, the paper's measure: no collision, and every point of the path within {NEAR:.0f} m of the track; "
    "a car that should stop must also stand that near to the path's last point.",
    "- strict success: success, never off the road, never in an oncoming lane outside junctions, and `finish` declared "
    f"within {FINISH_NEAR:.0f} m of the end of the path.",
    "- stuck: episodes in which the car came to a stand without having declared `finish`.",
    "- paper: success of the same model on the same input in Roh et al. 2019 (train: Town 1, test: Town 2), on routes "
    "of its own in CARLA.",
)
MOST_SHOWN_TOWNS = 4
SHOWN_CHARACTERS = 160  # of an instruction in the Markdown report; the JSON file has all


def summarise(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Count outcomes over everything, and per town, type and keyword.

    Args:
        outcomes: of any towns.

    Returns:
        ``{"episodes", "success", "strict_success", "stuck", "towns": {town: {the same four, "types", "keywords"}}}``,
        where ``types`` and ``keywords`` map each name that occurs to the same four. Success rates lie in [0, 1],
        rounded to 6 digits, None for no episode; the others are counts.
    """
    towns = {}
    for town in dict.fromkeys(outcome.episode.town for outcome in outcomes):
        towns[town] = _by_meaning([outcome for outcome in outcomes if outcome.episode.town == town])
    return _rates(outcomes) | {"towns": towns}


def _by_meaning(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    keywords = [outcome.episode.keyword for outcome in outcomes]
    types = _grouped(outcomes, [KEYWORDS[keyword].type for keyword in keywords], ("single", "double", "ordinal"))
    return _rates(outcomes) | {"types": types, "keywords": _grouped(outcomes, keywords, KEYWORDS)}


def _summaries(outcomes: Sequence[Outcome]) -> dict[str, dict[str, Any]]:
    """By town; many towns are one."""
    towns = summarise(outcomes)["towns"]
    return towns if len(towns) <= MOST_SHOWN_TOWNS else {f"{len(towns)} towns": _by_meaning(outcomes)}


def _rates(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    count = len(outcomes)
    return {
        "episodes": count,
        "success": round(sum(o.success for o in outcomes) / count, 6) if count else None,
        "strict_success": round(sum(o.strict_success for o in outcomes) / count, 6) if count else None,
        "stuck": sum(o.stuck for o in outcomes),
    }


def _grouped(outcomes: Sequence[Outcome], labels: Sequence[str], names: Iterable[str]) -> dict[str, dict[str, Any]]:
    groups = {name: [o for o, label in zip(outcomes, labels, strict=True) if label == name] for name in names}
    return {name: _rates(group) for name, group in groups.items() if group}


def to_json(outcomes: Sequence[Outcome], details: Mapping[str, str] | None = None) -> dict[str, Any]:
    """The whole evaluation as JSON values.

    Args:
        outcomes: in the order of the episode file.
        details: what else to tell by name, see :func:`to_markdown`.

    Returns:
        ``{"summary": summarise(outcomes), "details": {...}, "episodes": [record, ...]}``, the records in the outcomes'
        order.
    """
    records = [outcome.record() for outcome in outcomes]
    for record in records:
        # JSON has no NaN and no infinity, which a broken policy can leave behind.
        record |= {k: None for k, v in record.items() if isinstance(v, float) and not math.isfinite(v)}
    return {"summary": summarise(outcomes), "details": dict(details or {}), "episodes": records}


def write_json(outcomes: Sequence[Outcome], path: str | Path, details: Mapping[str, str] | None = None) -> None:
    """Write :func:`to_json` to a file, whole or not at all.

    Args:
        outcomes: in the order of the episode file.
        path: the file; its folder must exist.
        details: what else to tell by name.

    Raises:
        OSError: the file cannot be written.
    """
    # Escaped to ASCII, so that an id of lone surrogates, which JSON allows and UTF-8 does not, comes back unchanged.
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(to_json(outcomes, details), indent=1, allow_nan=False) + "\n", encoding="utf-8")


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Write a file whole or not at all: whatever fails inside the block, the file stays as it was.

    Args:
        path: the file to write.

    Yields:
        An empty file in the same folder to write to, moved to ``path`` at the end of the block.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    with _temporary_beside(Path(path)) as temporary:
        yield temporary
        temporary.replace(path)


def check_whole_numbers(settings: Mapping[str, Any], least: Mapping[str, int]) -> None:
    """Raise a ValueError that names a setting which is no whole number, or below the least that it may be."""
    for name, bound in least.items():
        if type(settings[name]) is not int or settings[name] < bound:
            raise ValueError(f"{name} is {settings[name]!r}; give a whole number of at least {bound}")


def check_writable(path: str | Path) -> None:
    """Raise :func:`replacing`'s OSError now, before a long evaluation, if its file could not be written in the end."""
    with _temporary_beside(Path(path)):
        pass


@contextmanager
def _temporary_beside(path: Path) -> Iterator[Path]:
    temporary = path.parent / f".{secrets.token_hex(8)}.tmp"
    try:
        # Moving a file onto a device, such as /dev/null, would replace the device.
        with suppress(FileNotFoundError):
            if not stat.S_ISREG(path.stat().st_mode):
                raise OSError("it is no regular file")
        temporary.touch()
        yield temporary
    except OSError as error:
        message = (
            f"cannot write {str(path)!r} ({error.strerror or error}); name a file in a folder that is yours to write"
        )
        raise OSError(message) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def table(outcomes: Sequence[Outcome], paper: Success | None = None) -> str:
    """The main table, for a terminal and for the report.

    Args:
        outcomes: of any towns.
        paper: success in the paper, see :func:`~ldrl.collectors.paper.paper_success`.

    Returns:
        A Markdown table: a row per town and type, then ``all``, with the paper's figure where it has one. More than
        four towns are taken together.
    """
    paper = paper or {}
    rows = [("town", "type", "episodes", "success", "strict success", "stuck", "paper")]
    for town, summary in _summaries(outcomes).items():
        for name, rates in (summary["types"] | {"all": summary}).items():
            rows.append((town, name, *_figures(rates), str(rates["stuck"]), _rate(paper.get(town, {}).get(name))))
    return markdown_table(rows, left=2)


def keyword_table(outcomes: Sequence[Outcome]) -> str:
    """Success and strict success of every keyword as a Markdown table, the towns, if four or fewer, side by side."""
    towns = _summaries(outcomes)
    rows = [("keyword", "type", *(f"{town} {name}" for town in towns for name in ("episodes", "success", "strict")))]
    for keyword in KEYWORDS.values():
        groups = [summary["keywords"].get(keyword.name) for summary in towns.values()]
        if any(groups):
            figures = [_figures(rates) if rates else ("0", "-", "-") for rates in groups]
            rows.append((keyword.name, keyword.type, *(cell for group in figures for cell in group)))
    return markdown_table(rows, left=2)


def to_markdown(
    outcomes: Sequence[Outcome],
    *,
    title: str = "Report",
    paper: Success | None = None,
    details: Mapping[str, str] | None = None,
) -> str:
    """A report to read: the main table, one per keyword, every episode that went wrong, and how it came about.

    Args:
        outcomes: of any towns.
        title: the heading.
        paper: success in the paper, as in :func:`table`.
        details: what else to tell by name, such as the configuration, the hardware, wall times and seeds.

    Returns:
        GitHub-flavoured Markdown.
    """
    wrong = [outcome for outcome in outcomes if not outcome.strict_success]
    parts = [
        f"# {_cell(title)}",
        f"{len(outcomes)} episodes, one drive each; {sum(outcome.stuck for outcome in outcomes)} of them ended stuck.",
        table(outcomes, paper),
        "\n".join(NOTES),
        "## Per keyword",
        keyword_table(outcomes),
        f"## Episodes without strict success: {len(wrong)}",
        _wrong_table(wrong) if wrong else "None.",
    ]
    if details:
        parts += ["## Details", markdown_table([("what", "value"), *details.items()], left=2)]
    return "\n\n".join(parts) + "\n"


def _wrong_table(outcomes: Sequence[Outcome]) -> str:
    rows = [("id", "instruction", "success", "what happened")]
    for outcome in outcomes:
        instruction = outcome.episode.instruction
        shown = instruction[:SHOWN_CHARACTERS] + "…" * (len(instruction) > SHOWN_CHARACTERS)
        happened = "; ".join(_what_happened(outcome))
        rows.append((outcome.episode.id, shown, "yes" if outcome.success else "no", happened))
    return markdown_table(rows, left=4)


def _what_happened(outcome: Outcome) -> Iterator[str]:
    if outcome.collision:
        yield "collision"
    if outcome.off_road:
        yield "off the road"
    if outcome.wrong_lane:
        yield "in an oncoming lane"
    if not outcome.largest_gap <= NEAR:  # so that NaN counts as missed
        yield f"missed the path by {outcome.largest_gap:.1f} m"
    elif outcome.episode.stop and not outcome.success and not outcome.collision:
        yield "did not stop at the end of the path"
    if outcome.stuck:
        yield "stuck"
    elif outcome.finish_distance is None:
        yield "did not declare finish"
    elif outcome.finish_distance > FINISH_NEAR:
        yield f"declared finish {outcome.finish_distance:.1f} m from the end of the path"


def _figures(rates: Mapping[str, Any]) -> tuple[str, str, str]:
    return str(rates["episodes"]), _rate(rates["success"]), _rate(rates["strict_success"])


def _rate(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _cell(text: str) -> str:
    """Text that stays in its cell and is shown as it is, whatever Markdown it resembles."""
    text = " ".join(text.encode("utf-8", "replace").decode().split())
    return re.sub(r"([\\`*_|<>\[\]])", r"\\\1", text)


def markdown_table(rows: Sequence[Sequence[str]], left: int) -> str:
    """A table whose first row is its header and whose first ``left`` columns are words, the others figures."""
    cells = [[_cell(text) for text in row] for row in rows]
    widths = [max(3, *map(len, column)) for column in zip(*cells, strict=True)]
    sides = ["<"] * left + [">"] * (len(widths) - left)
    rule = ["-" * width if side == "<" else "-" * (width - 1) + ":" for width, side in zip(widths, sides, strict=True)]
    shape = " | ".join(f"{{:{side}{width}}}" for width, side in zip(widths, sides, strict=True))
    return "\n".join(f"| {shape.format(*row)} |" for row in (cells[0], rule, *cells[1:]))
