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

    def show_steps(self, fraction: float, steps: int, increment: float) -> None:
        """Update the bar of an explicit solve."""
        self._bar.update(self._task, completed=fraction, description=f"{steps} increments of {increment:.2g} s")


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

    def show(self, step: int, loss: float, inner: int, left: float) -> None:
        """Update the line."""
        text = f"solve {step}, misfit {loss:.5g}, {inner} inner iterations, {left:.2g} to go"
        self._bar.update(self._task, description=text)

    def drawn(self, count: int, draws: int) -> None:
        """Update the line while the posterior is drawn from."""
        self._bar.update(self._task, description=f"draw {count} of {draws} of the posterior")
