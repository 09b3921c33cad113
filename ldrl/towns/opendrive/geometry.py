"""Curves of OpenDRIVE: the primitives of a road's reference line, and piecewise cubic polynomials along it.

Everything here is in OpenDRIVE's own frame: x east, y north, headings counter-clockwise, t to the left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

__all__ = ["Clothoid", "Geometry", "Parametric", "cubic", "reference_line"]

NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
PARAMETER_STEP = 0.1
"""Step of the table from arc length to parameter, m."""


class Curve(Protocol):
    """A curve from the origin, whose first direction is its own affair."""

    def poses(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x, y (m) and heading (rad) at sorted arc lengths ``u`` (``[N]``, m)."""


@dataclass(frozen=True)
class Clothoid:
    """A curve whose curvature changes linearly: also a straight line or an arc.

    Args:
        length: m.
        start: curvature at its start, positive to the left, 1/m.
        end: curvature at its end, 1/m.
    """

    length: float
    start: float = 0.0
    end: float = 0.0

    def poses(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Poses, by Gauss-Legendre quadrature of the direction between neighbouring arc lengths."""
        before = np.concatenate(([0.0], u[:-1]))
        nodes = before[:, None] + np.diff(u, prepend=0.0)[:, None] * (NODES + 1) / 2
        weights = np.diff(u, prepend=0.0)[:, None] * WEIGHTS / 2
        heading = self._heading(nodes)
        x, y = (np.cumsum((weights * part(heading)).sum(1)) for part in (np.cos, np.sin))
        return x, y, self._heading(u)

    def _heading(self, u: np.ndarray) -> np.ndarray:
        return u * (self.start + (self.end - self.start) * u / (2 * self.length))


@dataclass(frozen=True)
class Parametric:
    """A curve ``(u(p), v(p))`` of two cubic polynomials: ``paramPoly3``, and with ``u = p`` a ``poly3``.

    Poses are asked for by arc length; the parameter there is looked up in a table.

    Args:
        length: m.
        u: coefficients, lowest order first.
        v: coefficients, lowest order first.
        last: the parameter at the curve's end; None for where its arc length reaches ``length``.
    """

    length: float
    u: Sequence[float]
    v: Sequence[float]
    last: float | None

    def poses(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Poses.

        Raises:
            ValueError: the curve stands still somewhere.
        """
        steps = math.ceil(self.length / PARAMETER_STEP) + 32
        table = np.linspace(0, self.length if self.last is None else self.last, steps)
        nodes = table[:-1, None] + np.diff(table)[:, None] * (NODES + 1) / 2
        slopes = [np.polynomial.polynomial.polyder(coefficients) for coefficients in (self.u, self.v)]
        speed = np.hypot(*(np.polynomial.polynomial.polyval(nodes, slope) for slope in slopes))
        arc = np.concatenate(([0.0], (speed * WEIGHTS / 2).sum(1) * np.diff(table))).cumsum()
        if not (np.diff(arc) > 0).all():
            raise ValueError("a polynomial of its planView stands still; check its coefficients")
        p = np.interp(u * (1.0 if self.last is None else arc[-1] / self.length), arc, table)
        x, y = (np.polynomial.polynomial.polyval(p, coefficients) for coefficients in (self.u, self.v))
        dx, dy = (np.polynomial.polynomial.polyval(p, slope) for slope in slopes)
        return x, y, np.arctan2(dy, dx)


@dataclass(frozen=True)
class Geometry:
    """A primitive of a reference line and where it starts.

    Args:
        s: arc length of the road at its start, m.
        x: of its start, m.
        y: of its start, m.
        heading: of its local frame, rad.
        curve: in that frame.
    """

    s: float
    x: float
    y: float
    heading: float
    curve: Clothoid | Parametric


def cubic(records: np.ndarray, s: np.ndarray) -> np.ndarray:
    """A piecewise cubic polynomial.

    Args:
        records: ``[K, 5]``: start and coefficients a, b, c, d of each piece, sorted by start.
        s: where, ``[N]``.

    Returns:
        ``[N]``; zero before the first piece.

    Examples:
        >>> cubic(np.array([[0, 1, 0, 0, 0], [10, 1, 0.5, 0, 0]]), np.array([5.0, 12.0]))
        array([1., 2.])
    """
    if not len(records):
        return np.zeros_like(s)
    piece = np.searchsorted(records[:, 0], s, side="right") - 1
    start, a, b, c, d = records[piece.clip(0)].T
    u = s - start
    return np.where(piece < 0, 0.0, a + u * (b + u * (c + u * d)))


def reference_line(geometries: Sequence[Geometry], s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evaluate a road's reference line.

    Args:
        geometries: sorted by ``s``; the first starts at 0.
        s: sorted arc lengths, ``[N]``, m.

    Returns:
        x, y (m) and unwrapped heading (rad), each ``[N]``.
    """
    pieces = np.searchsorted([geometry.s for geometry in geometries], s, side="right") - 1
    x, y, heading = np.empty((3, len(s)))
    for k in np.unique(pieces):
        geometry, here = geometries[k], pieces == k
        u, v, turn = geometry.curve.poses(s[here] - geometry.s)
        cos, sin = math.cos(geometry.heading), math.sin(geometry.heading)
        x[here], y[here] = geometry.x + u * cos - v * sin, geometry.y + u * sin + v * cos
        heading[here] = geometry.heading + turn
    return x, y, np.unwrap(heading)
