"""What a long call is doing: a bar on a terminal, a line of text in a notebook, lines in a log.

Everything that takes long says its stages here; what is called inside joins what called it.
"""

import contextvars
import threading
from types import TracebackType
from typing import Any, NamedTuple

from jax import monitoring
from rich.console import Console
from rich.progress import BarColumn, Progress as Bar, TextColumn, TimeElapsedColumn

_TICK = 0.25  # [s] between looks at what XLA does and how late it is
_EVERY = 8.0  # [s] between lines of a log: none is silent for 10 s
_PATIENCE = 5.0  # [s] that a stage of a library call takes before a log hears of it
_LONG = 20.0  # [s] from which on it is said how long is left
_NOTABLE = 3.0  # [s] of one compilation before it is mentioned; one that is kept on disk is read in less

# Compilations under way, by thread: when each began.
_COMPILING: dict[int, float] = {}
_OPEN: list["Progress"] = []
_LOCK = threading.Lock()


class _Now(NamedTuple):
    """What is shown."""

    text: str = "starting"
    fraction: float | None = None
    compiles: str | None = None
    stage: int = 0
    since: float = 0.0


class Progress:
    """Shows what a call is doing, from `with` to its end; inside another one it adds its stages to that.

    Where there is neither a terminal nor a notebook it prints lines on stderr, with the seconds since it began.
    Compilations that take long are seen and said by itself.

    Args:
        wanted: Whether to show anything.
        at_once: In a log, say each stage when it begins; else those that last long, so that many short calls are quiet.
        alone: Calls inside show nothing: for many of a kind, of which their count tells enough.
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
            text: What is done, in a word or two.
            compiles: What is compiled and for how long, to be said when that takes long.
        """
        if self._display is not None:
            self._display.begin(text, compiles)

    def show(self, text: str, fraction: float | None = None, *, estimate: bool = False) -> None:
        """Say how far the stage is.

        Args:
            text: What there is to say.
            fraction: Part of the stage that is done [-], where it is known.
            estimate: Say, too, how long the stage may still take, where that is long.
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
    """What the outermost `Progress` and all inside share: what is shown, and a thread that keeps it up to date."""

    def __init__(self, at_once: bool):
        _listen()
        self.now = _Now()
        self._console = console = Console(stderr=True)
        self._begin = self._last = self._time()
        self._patience = 0.0 if at_once else _PATIENCE
        self._count = 0
        self._said: tuple[int, bool] = (0, False)  # the stage of the last line, and whether it said "compiling"
        self._paced: tuple[int, float, float] | None = None  # stage, and when a fraction of it was first heard of
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
        # In the context of the caller, which tells a notebook the cell that a line belongs to.
        context = contextvars.copy_context()
        self._watch = threading.Thread(target=context.run, args=(self._keep_up,), name="opfem progress", daemon=True)
        self._watch.start()

    def begin(self, text: str, compiles: str | None) -> None:
        """Begin a stage."""
        self._count += 1
        self.put(_Now(text, None, compiles, self._count, self._time()))

    def time_left(self, fraction: float) -> str:
        """Say how long the stage may still take, at the pace since it was first heard of: what compiles is before."""
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
        """Show something else."""
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
        """Leave nothing behind on a terminal."""
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
    """Hear from JAX, once, when a compilation begins and ends; it has no word for the former but these."""
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
