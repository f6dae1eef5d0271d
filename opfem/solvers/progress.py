"""A progress bar for untraced solves."""

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn


class LoadProgress:
    """Shows the load fraction on a terminal or in a notebook; silent elsewhere."""

    def __init__(self, wanted: bool):
        console = Console(stderr=True)
        columns = (
            TextColumn("load"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f}%"),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
        )
        self._bar = Progress(
            *columns,
            console=console,
            transient=True,
            disable=not (wanted and (console.is_terminal or console.is_jupyter)),
        )
        self._task = self._bar.add_task("compiling", total=1.0)

    def __enter__(self) -> "LoadProgress":
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def show(self, fraction: float, attempts: int, newton: int, snaps: bool) -> None:
        """Update the bar."""
        text = f"solve {attempts}, {newton} Newton steps" + (", snapping" if snaps else "")
        self._bar.update(self._task, completed=fraction, description=text)


class FitProgress:
    """Shows what a fit has done so far on a terminal or in a notebook; silent elsewhere."""

    def __init__(self, wanted: bool):
        console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("fit"),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not (wanted and (console.is_terminal or console.is_jupyter)),
        )
        self._task = self._bar.add_task("compiling", total=None)

    def __enter__(self) -> "FitProgress":
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def show(self, step: int, loss: float, inner: int) -> None:
        """Update the line."""
        self._bar.update(self._task, description=f"step {step}, misfit {loss:.5g}, {inner} inner iterations")
