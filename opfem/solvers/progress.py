"""Progress of a long call: a bar on a terminal, a line of text in a notebook, lines in a log.

Long functions report their stages here; nested calls report to the outermost one.
"""

import contextvars
import threading
from types import TracebackType
from typing import Any, NamedTuple

from jax import monitoring
from rich.console import Console
from rich.progress import BarColumn, Progress as Bar, TextColumn, TimeElapsedColumn

_TICK = 0.25  # [s] between updates of clock and compilations
_EVERY = 8.0  # [s] between lines of a log: at least one in 10 s
_PATIENCE = 5.0  # [s] of a stage of a library call before a log shows it
_LONG = 20.0  # [s] of remaining time from which on it is shown
_NOTABLE = 3.0  # [s] of one compilation before it is shown; reading one from the cache takes less

# Start times of current compilations, by thread.
_COMPILING: dict[int, float] = {}
_OPEN: list["Progress"] = []
_LOCK = threading.Lock()


class _Now(NamedTuple):
    """The displayed line."""

    text: str = "starting"
    fraction: float | None = None
    compiles: str | None = None
    stage: int = 0
    since: float = 0.0


class Progress:
    """Context manager that shows the progress of a call; inside another one it adds its stages to that.

    Without terminal and notebook it prints lines on stderr, with the seconds since its start. It detects and shows long
    compilations.

    Args:
        wanted: Whether to show anything.
        at_once: In a log, show each stage at its start; else long ones only, so that many short calls print nothing.
        alone: Nested calls show nothing: for many similar ones, which a counter represents.
    """

    def __init__(self, wanted: bool, *, at_once: bool = False, alone: bool = False):
        self._wanted, self._at_once, self._alone = wanted, at_once, alone
        self._display: _Display | None = None
        self._former: _Now | None = None

    def __enter__(self) -> "Progress":
        if not self._wanted:
            return self
        with _LOCK:
            if not _OPEN:
                self._display = _Display(self._at_once)
            elif not any(outer._alone for outer in _OPEN):
                self._display = _OPEN[0]._display
                self._former = None if self._display is None else self._display.now
            if self._display is not None:
                _OPEN.append(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._display is None:
            return
        with _LOCK:
            _OPEN.remove(self)
        if self._former is None:
            self._display.stop()
        else:
            self._display.put(self._former)

    def stage(self, text: str, *, compiles: str | None = None) -> None:
        """Begin a stage.

        Args:
            text: Name of the stage, in a word or two.
            compiles: Name and duration of the compilation, shown when it takes long.
        """
        if self._display is not None:
            self._display.begin(text, compiles)

    def show(self, text: str, fraction: float | None = None, *, estimate: bool = False) -> None:
        """Update the stage.

        Args:
            text: Text of the line.
            fraction: Completed part of the stage [-], if known.
            estimate: Show the remaining time as well, if it is long.
        """
        if self._display is not None:
            if estimate and fraction is not None:
                text += self._display.time_left(fraction)
            self._display.put(self._display.now._replace(text=text, fraction=fraction))

    def line(self, text: str) -> None:
        """Say something once, in a log only, where the stage is not one of a short library call."""
        if self._display is not None:
            self._display.line(text)


class _Display:
    """Display shared by the outermost `Progress` and all nested ones, with a thread that updates it."""

    def __init__(self, at_once: bool):
        _listen()
        self.now = _Now()
        self._console = console = Console(stderr=True)
        self._begin = self._last = self._time()
        self._patience = 0.0 if at_once else _PATIENCE
        self._count = 0
        self._said: tuple[int, bool] = (0, False)  # the stage of the last line, and whether it said "compiling"
        self._paced: tuple[int, float, float] | None = None  # stage, and time of its first fraction
        self._bar: Bar | None = None
        self._handle: Any = None
        self._written = ""
        self._lock = threading.Lock()
        if console.is_jupyter:
            self._handle = _notebook_line()
        elif console.is_interactive:
            columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
            self._bar = Bar(*columns, console=console, transient=True, redirect_stdout=Console().is_terminal)
            self._task = self._bar.add_task("starting", total=None)
            self._bar.start()
        self._ended = threading.Event()
        # In the context of the caller, which identifies the notebook cell of a line.
        context = contextvars.copy_context()
        self._watch = threading.Thread(target=context.run, args=(self._keep_up,), name="opfem progress", daemon=True)
        self._watch.start()

    def begin(self, text: str, compiles: str | None) -> None:
        """Begin a stage."""
        self._count += 1
        self.put(_Now(text, None, compiles, self._count, self._time()))

    def time_left(self, fraction: float) -> str:
        """Estimate the remaining time at the rate since the first fraction, which excludes compilation."""
        time, stage = self._time(), self.now.stage
        if self._paced is None or self._paced[0] != stage or fraction <= self._paced[2]:
            self._paced = (stage, time, fraction)
            return ""
        _, since, done = self._paced
        left = (1.0 - fraction) * (time - since) / (fraction - done)
        if left < _LONG:
            return ""
        return f", about {left:.0f} s left" if left < 100.0 else f", about {left / 60.0:.0f} min left"

    def put(self, now: _Now) -> None:
        """Change the line."""
        _COMPILING.pop(threading.get_ident(), None)
        self.now = now
        if self._bar is not None or (self._patience == 0 and now.stage > self._said[0]):
            self._update(False)

    def line(self, text: str) -> None:
        """Print a line in a log; a terminal and a notebook show how far all is instead."""
        time = self._time()
        if self._bar is None and self._handle is None and time - self.now.since >= self._patience:
            with self._lock:
                self._print(text, time)

    def stop(self) -> None:
        """Clear the line on a terminal."""
        self._ended.set()
        self._watch.join()
        if self._bar is not None:
            self._bar.stop()
        if self._handle is not None:
            self._write("")

    def _keep_up(self) -> None:
        while not self._ended.wait(_TICK):
            self._update(any(self._time() - since > _NOTABLE for since in list(_COMPILING.values())))

    def _update(self, compiling: bool) -> None:
        now, time = self.now, self._time()
        text = now.text
        if compiling:
            what = f"compiling {now.compiles}" if now.compiles else f"{text}: compiling"
            text = f"still {what.partition(',')[0]}" if self._said == (now.stage, True) else what
        if self._bar is not None:
            # A total of None, without an end, cannot be given to update; at an end the clock would stop.
            self._bar.tasks[0].total = None if now.fraction is None else 1.0
            self._bar.update(self._task, description=text, completed=min(now.fraction or 0.0, 0.999))
        elif self._handle is not None:
            self._write(f"{text} ({time - self._begin:.0f} s)")
        else:
            self._log(text, (now.stage, compiling or self._said == (now.stage, True)), time - now.since, time)

    def _log(self, text: str, state: tuple[int, bool], age: float, time: float) -> None:
        with self._lock:
            news = state > self._said and age >= self._patience
            if news or time - self._last >= max(_EVERY, self._patience):
                self._said = max(state, self._said)
                self._print(text, time)

    def _print(self, text: str, time: float) -> None:
        self._last = time
        line = f"opfem {time - self._begin:4.0f} s  {text}"
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def _write(self, line: str) -> None:
        if line != self._written:
            self._written = line
            self._handle.update(_text(line))

    def _time(self) -> float:
        return self._console.get_time()


def _notebook_line() -> Any:
    from IPython.display import display  # a notebook has it

    return display(_text("starting"), display_id=True)


def _text(text: str) -> Any:
    from IPython.display import Pretty

    return Pretty(text)


def _listen() -> None:
    """Register with JAX, once, for the start and end of compilations; only these events mark a start."""
    if _LISTENING:
        return
    _LISTENING.append(True)
    console = Console()

    def happened(event: str, **_: Any) -> None:
        if event == "/jax/compilation_cache/compile_requests_use_cache":
            _COMPILING[threading.get_ident()] = console.get_time()

    def ended(event: str, duration_secs: float, **_: Any) -> None:
        if event == "/jax/core/compile/jaxpr_to_mlir_module_duration":
            _COMPILING[threading.get_ident()] = console.get_time()
        elif event == "/jax/core/compile/backend_compile_duration":
            _COMPILING.pop(threading.get_ident(), None)

    monitoring.register_event_listener(happened)
    monitoring.register_event_duration_secs_listener(ended)


_LISTENING: list[bool] = []
