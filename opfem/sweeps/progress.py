"""How far a sweep is: points, rate, failures, time left; in a log a line for each point."""

import time
from collections.abc import Mapping
from typing import Any

from ..solvers.progress import Progress
from .store import Outcome


class SweepProgress:
    """Progress of a sweep.

    Args:
        shown: Display of the progress.
        total: Points of the sweep.
        finished: Points that an earlier run has finished.
    """

    def __init__(self, shown: Progress, total: int, finished: int):
        self._shown = shown
        self._total, self._finished, self._done, self._failed = total, finished, 0, 0
        self._begin = time.perf_counter()

    def finished(self, point: Mapping[str, Any], outcome: Outcome) -> None:
        """Count a point that has just been finished.

        Args:
            point: Its value on each axis.
            outcome: How it ended.
        """
        self._done += 1
        self._failed += outcome.failed
        reached = self._finished + self._done
        self._shown.show(f"{reached} of {self._total} points, {self.text()}", reached / self._total)
        place = ", ".join(
            f"{name} {value if isinstance(value, str) else f'{value:.6g}'}" for name, value in point.items()
        )
        ended = outcome.status if outcome.failed else f"{outcome.seconds:.3g} s"
        self._shown.line(f"{reached} of {self._total} points: {place}: {ended}; {self.text()}")

    def text(self) -> str:
        """Show rate, failures and remaining time; compilation is part of the time of the first points."""
        elapsed = max(time.perf_counter() - self._begin, 1e-9)
        rate = self._done / elapsed
        left = (self._total - self._finished - self._done) / rate if rate > 0 else float("inf")
        minutes, seconds = divmod(int(left), 60) if left < float("inf") else (0, 0)
        return f"{rate:.3g} points/s, {self._failed} failed, {minutes}:{seconds:02d} left"
