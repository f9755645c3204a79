"""How far a history is, and the time left, in a terminal."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

__all__ = ["ProgressBar"]

logger = logging.getLogger("fenics_contact")


class ProgressBar(logging.Filter):
    """A bar of tqdm that is there while increments are solved, and gone in between.

    So what a script prints of a step stands on lines of its own, and so do lines of the log, before
    which it is wiped off. It counts the way of the load from start to end, which cuts do not
    change. Where there is neither a terminal nor a notebook nothing is shown. Of the first rank.

    Args:
        words: At its head; may be empty.

    Raises:
        ValueError: There is no tqdm.
    """

    def __init__(self, words: str, start: float, end: float) -> None:
        super().__init__()
        try:
            from tqdm import tqdm
        except ImportError as error:
            raise ValueError(
                "progress needs tqdm, which is not installed: install it, or omit progress"
            ) from error
        self._make, self._words = tqdm, f"{words}: " if words else ""
        self._start, self._way = start, end - start
        self._bar: Any = None

    def lead(self, load: float) -> None:
        """Say which load is tried; the first is where the history begins, or goes on."""
        if self._bar is not None:
            return
        self._bar = self._make(
            total=1.0,
            initial=self._share(load),
            desc=self._words,
            bar_format="{desc}{percentage:3.0f}%|{bar:20}|{postfix}, {elapsed}<{remaining}",
            postfix=f"load {load:g}",
            mininterval=0,
            miniters=0,
            # None: silent where there is no terminal; a notebook is none, and shows it.
            disable=False if "ipykernel" in sys.modules else None,
        )

    def _share(self, load: float) -> float:
        return (load - self._start) / self._way

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show it inside of the block; it stays where the block fails or ends the history."""
        logger.addFilter(self)
        try:
            if self._bar is not None:
                self._bar.refresh()
            yield
        except BaseException:
            if self._bar is not None:
                self._bar.close()
            raise
        finally:
            logger.removeFilter(self)

    def reach(self, load: float) -> None:
        """Count the way to a load that was committed, and make room for what the script says."""
        self._bar.set_postfix_str(f"load {load:g}", refresh=False)
        self._bar.update(self._share(load) - self._bar.n)
        self._bar.clear()

    def wipe(self) -> None:
        """Take it away: the script has left the history."""
        if self._bar is not None:
            self._bar.leave = False
            self._bar.close()

    def filter(self, record: logging.LogRecord) -> bool:
        """Let every record through, on a line of its own."""
        if self._bar is not None:
            self._bar.clear()
        return True
