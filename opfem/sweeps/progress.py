"""How far a sweep is: points, rate, failures, time left."""

import time

from ..solvers.progress import Progress


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

    def show(self, done: int, failed: int) -> None:
        """Count points that have just been finished."""
        self._done += done
        self._failed += failed
        reached = self._finished + self._done
        self._shown.show(f"{reached} of {self._total} points, {self.text()}", reached / self._total)

    def text(self) -> str:
        """Show rate, failures and remaining time; compilation is part of the time of the first points."""
        elapsed = max(time.perf_counter() - self._begin, 1e-9)
        rate = self._done / elapsed
        left = (self._total - self._finished - self._done) / rate if rate > 0 else float("inf")
        minutes, seconds = divmod(int(left), 60) if left < float("inf") else (0, 0)
        return f"{rate:.3g} points/s, {self._failed} failed, {minutes}:{seconds:02d} left"
