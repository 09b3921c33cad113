"""Reading OpenDRIVE files of any origin within bounds of time and memory.

OpenDRIVE says everything in attributes, and most of its elements are not needed here. So the file is read as a stream
in which text and unneeded elements are skipped, and each road becomes a record as soon as it ends. Document type
declarations are refused, which leaves no entity to expand and none to fetch.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element
from xml.parsers import expat

from ldrl.towns.opendrive import elements
from ldrl.towns.opendrive.records import Connection, OpenDrive, Road

__all__ = ["read_opendrive"]

MAX_BYTES = 50_000_000
"""Larger files are refused, bytes."""
MAX_TOTAL = 1_000_000.0
"""Length of all roads, m."""
WANTED = {
    *("OpenDRIVE", "header", "road", "link", "predecessor", "successor", "planView", "geometry", "line", "arc"),
    *("spiral", "poly3", "paramPoly3", "lanes", "laneOffset", "laneSection", "left", "right", "lane", "width"),
    *("border", "junction", "connection", "laneLink"),
}
"""The elements that are kept; all others are skipped with what is in them."""


def read_opendrive(path: str | Path) -> OpenDrive:
    """Read a file.

    Args:
        path: of an ``.xodr`` file of OpenDRIVE 1.4 to 1.7, at most 50 MB.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no such file or something in it is wrong; the message names the road.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no map {str(path)!r}; give an OpenDRIVE file (.xodr)")
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(f"map {path} has {size / 1e6:.0f} MB, the limit is {MAX_BYTES / 1e6:.0f}; cut it into parts")
    reader = _Reader()
    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = reader.start, reader.end
    parser.StartDoctypeDeclHandler = _refuse_doctype
    try:
        with path.open("rb") as file:
            parser.ParseFile(file)
    except (expat.ExpatError, LookupError) as error:
        raise ValueError(f"map {path} is no XML, or cut off ({error}); give a whole OpenDRIVE file") from None
    except ValueError as error:
        raise ValueError(f"map {path}: {error}") from None
    return OpenDrive(reader.roads, reader.junctions)


def _refuse_doctype(*_: object) -> None:
    raise ValueError("it declares a document type, which OpenDRIVE does not need; remove the <!DOCTYPE ...>")


class _Reader:
    """Builds elements, and turns each road and junction into its dataclass when it ends."""

    def __init__(self) -> None:
        self.roads: dict[str, Road] = {}
        self.junctions: dict[str, tuple[Connection, ...]] = {}
        self._open: list[Element] = []
        self._skipped = 0
        self._version_known = False
        self._total = 0.0

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        if not self._open and tag != "OpenDRIVE":
            raise ValueError(f"its root is <{tag:.40}>, not <OpenDRIVE>; give an OpenDRIVE file")
        if self._skipped or tag not in WANTED:
            self._skipped += 1
            return
        element = Element(tag, attributes)
        if len(self._open) > 1:
            self._open[-1].append(element)
        self._open.append(element)

    def end(self, _: str) -> None:
        if self._skipped:
            self._skipped -= 1
            return
        element = self._open.pop()
        if len(self._open) == 1 and element.tag == "header":
            elements.check_version(element)
            self._version_known = True
        elif len(self._open) == 1:
            if not self._version_known:
                raise ValueError("it has no <header> with revMajor and revMinor before its roads; add one")
            self._add(element)

    def _add(self, element: Element) -> None:
        name = element.get("id", "")
        try:
            if not name or name in (self.roads if element.tag == "road" else self.junctions):
                raise ValueError("give it an id of its own")
            if element.tag == "road":
                self.roads[name] = elements.road(element, name)
                self._total += self.roads[name].length
                if self._total > MAX_TOTAL:
                    raise ValueError(
                        f"roads are longer than {MAX_TOTAL / 1000:g} km up to here; cut the map into parts"
                    )
            elif element.tag == "junction":
                self.junctions[name] = tuple(map(elements.connection, element.iter("connection")))
        except ValueError as error:
            raise ValueError(f"{element.tag} {name!r:.60}: {error}") from None
