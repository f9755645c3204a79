"""Progress bar of a load history."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

__all__ = ["ProgressBar"]

logger = logging.getLogger("fenics_contact")


class ProgressBar(logging.Filter):
    """Progress bar (tqdm) on the first rank, visible while an increment is solved.

    It shows the completed fraction of the load path and the remaining time, in a terminal or a
    notebook. It is cleared before log records and between increments.

    Raises:
        ValueError: tqdm is not installed.
    """

    def __init__(self, title: str, start: float, end: float) -> None:
        super().__init__()
        try:
            from tqdm import tqdm
        except ImportError as error:
            raise ValueError(
                "progress needs tqdm, which is not installed: install it, or omit progress"
            ) from error
        self._create_bar, self._title = tqdm, f"{title}: " if title else ""
        self._start, self._load_range = start, end - start
        self._bar: Any = None

    def start_bar(self, load: float) -> None:
        """Create the bar at the first call, with the load at which the history starts."""
        if self._bar is not None:
            return
        self._bar = self._create_bar(
            total=1.0,
            initial=self._fraction(load),
            desc=self._title,
            bar_format="{desc}{percentage:3.0f}%|{bar:20}|{postfix}, {elapsed}<{remaining}",
            postfix=f"load {load:g}",
            mininterval=0,
            miniters=0,
            # With None tqdm is silent without a terminal, and therefore in notebooks.
            disable=False if "ipykernel" in sys.modules else None,
        )

    def _fraction(self, load: float) -> float:
        return (load - self._start) / self._load_range

    @contextmanager
    def show(self) -> Iterator[None]:
        """Show the bar inside the block; close it if the block fails or ends the history."""
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

    def update(self, load: float) -> None:
        """Advance the bar to a committed load, and clear it for the output of the script."""
        self._bar.set_postfix_str(f"load {load:g}", refresh=False)
        self._bar.update(self._fraction(load) - self._bar.n)
        self._bar.clear()

    def remove(self) -> None:
        """Remove the bar, because the script has left the history."""
        if self._bar is not None:
            self._bar.leave = False
            self._bar.close()

    def filter(self, record: logging.LogRecord) -> bool:
        """Clear the bar before a log record; accept every record."""
        if self._bar is not None:
            self._bar.clear()
        return True
