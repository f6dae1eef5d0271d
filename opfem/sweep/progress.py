"""A progress bar of a sweep: points, rate, failures, time left."""

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn


class SweepProgress:
    """Shows how far a sweep is on a terminal or in a notebook; silent elsewhere.

    Args:
        wanted: Whether to show anything.
        total: Points of the sweep.
        finished: Points that an earlier run has finished.
    """

    def __init__(self, wanted: bool, total: int, finished: int):
        console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("sweep"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.description}"),
            console=console,
            transient=True,
            disable=not (wanted and (console.is_terminal or console.is_jupyter)),
        )
        self._task = self._bar.add_task("compiling", total=total, completed=finished)
        self._total, self._finished, self._done, self._failed = total, finished, 0, 0
        self._begin = time.perf_counter()

    def __enter__(self) -> "SweepProgress":
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def show(self, done: int, failed: int) -> None:
        """Count points that have just been finished."""
        self._done += done
        self._failed += failed
        self._bar.update(self._task, completed=self._finished + self._done, description=self.text())

    def text(self) -> str:
        """Say rate, failures and time left; compilation counts as time of the first points."""
        elapsed = max(time.perf_counter() - self._begin, 1e-9)
        rate = self._done / elapsed
        left = (self._total - self._finished - self._done) / rate if rate > 0 else float("inf")
        minutes, seconds = divmod(int(left), 60) if left < float("inf") else (0, 0)
        return f"{rate:.3g} points/s, {self._failed} failed, {minutes}:{seconds:02d} left"
