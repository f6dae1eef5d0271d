"""Where and how the points of a sweep are computed: `Batch` on one device, `Devices` on all of a machine.

Points are computed in batches of fixed membership, so that a point's bits do not depend on what else is
finished: a batch that was interrupted runs again as it was.
"""

import dataclasses
import os
import re
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array

from .._device import choices
from .outputs import ERROR, NONFINITE, STATUS, Label, OutputError, Outputs, ending
from .plan import Plan, check_settings, settled
from .store import Outcome

Columns = dict[str, np.ndarray]
# A message in a table is one line.
_LONGEST_MESSAGE = 300


class Program:
    """A function compiled for batches of one size.

    Args:
        fn: The function of a sweep.
        outputs: Outputs to store.
        plan: How batches are computed.
        example: Columns of any points, for their types.
    """

    def __init__(self, fn: Callable, outputs: Outputs, plan: Plan, example: Columns):
        self._fn, self._outputs, self._plan = fn, outputs, plan
        self._labels: dict[str, Label] = {}
        self._compiled = None if plan.mode == "call" else self._compile(_padded(example, plan.points))

    def outcomes(self, columns: Columns) -> list[Outcome]:
        """Compute the points of a batch; an exception becomes an outcome."""
        count = len(next(iter(columns.values())))
        if self._compiled is None:
            points = [{name: column[i].item() for name, column in columns.items()} for i in range(count)]
            return [self._guarded(partial(self._called, point), 1)[0] for point in points]
        batch = self._guarded(partial(self._run, columns), count)
        if count > 1 and batch[0].status == ERROR:
            # A batch does not identify the point that raised: repeat the points one by one.
            alone = [{name: column[i : i + 1] for name, column in columns.items()} for i in range(count)]
            return [self._guarded(partial(self._run, point), 1)[0] for point in alone]
        return batch

    def _guarded(self, compute: Callable[[], list[tuple[dict, dict]]], count: int) -> list[Outcome]:
        begin = time.perf_counter()
        try:
            answers = compute()
        except OutputError:
            raise
        except Exception as cause:
            seconds = (time.perf_counter() - begin) / count
            return count * [Outcome(ERROR, _one_line(cause), seconds, {}, {})]
        seconds = (time.perf_counter() - begin) / count
        return [_outcome(values, labels, seconds) for values, labels in answers]

    def _called(self, point: dict[str, Any]) -> list[tuple[dict, dict]]:
        values, labels = self._outputs.arrays(self._fn(**point))
        return [({name: np.asarray(value) for name, value in values.items()}, labels)]

    def _run(self, columns: Columns) -> list[tuple[dict, dict]]:
        count = len(next(iter(columns.values())))
        assert self._compiled is not None
        answer = jax.device_get(self._compiled(_padded(columns, self._plan.points)))
        return [({name: np.asarray(value[i]) for name, value in answer.items()}, self._labels) for i in range(count)]

    def _compile(self, example: Columns):
        size = self._plan.size

        def one(point: dict[str, Array]) -> dict[str, Array]:
            values, labels = self._outputs.arrays(self._fn(**point))
            self._labels.update(labels)
            return values

        def batch(columns: dict[str, Array]) -> dict[str, Array]:
            if self._plan.mode == "vmap":
                return jax.vmap(one)(columns)
            if size == 1:
                return jax.tree.map(lambda v: v[None], one({name: column[0] for name, column in columns.items()}))
            return jax.lax.map(one, columns)

        if self._plan.devices > 1:
            # Each device goes through its own points: a loop over all of them would wait for the slowest in each step.
            axis = PartitionSpec("points")
            mesh = Mesh(np.array(jax.local_devices()[: self._plan.devices]), ("points",))
            batch = jax.shard_map(batch, mesh=mesh, in_specs=axis, out_specs=axis, check_vma=False)
        return jax.jit(batch).lower(example).compile()


def _padded(columns: Columns, size: int) -> Columns:
    """Repeat the last point of an incomplete batch, which must have the shape of the others."""
    return {name: np.pad(column, (0, size - len(column)), mode="edge") for name, column in columns.items()}


def _outcome(values: dict[str, np.ndarray], labels: dict[str, Label], seconds: float) -> Outcome:
    status, message = ending(values)
    values = {name: value for name, value in values.items() if name != STATUS}
    if status == NONFINITE:
        values = {n: np.full_like(v, np.nan) if v.dtype.kind == "f" else v for n, v in values.items()}
    return Outcome(status, message, seconds, values, {name: labels[name] for name in values})


def _one_line(cause: Exception) -> str:
    """Return the line of a message that names the error: of an error inside compiled code, that of the inner one."""
    lines = [line.strip() for line in str(cause).splitlines() if line.strip()]
    inner = [line for line in lines if re.match(r"[\w.]+Error: ", line)]
    text = inner[-1] if inner else f"{type(cause).__name__}: {lines[0] if lines else 'no message'}"
    return text[:_LONGEST_MESSAGE]


@dataclasses.dataclass(frozen=True)
class Batch:
    """Compute on one device.

    Args:
        size: Points that one call of the compiled program computes; None: 1, or 32 with "vmap".
        mode: "map", "vmap", "call" (for functions that jit cannot trace, such as `fit_traction`) or "auto": "map" on a
            CPU, where lanes that wait for the slowest cost as much as those that work, "vmap" on an accelerator, "call"
            where tracing fails.
        threads: Batches computed side by side; None: one for each core on a CPU, else one.

    Raises:
        ValueError: If a number is below 1 or the mode is unknown.
    """

    size: int | None = None
    mode: str = "auto"
    threads: int | None = None

    def __post_init__(self):
        check_settings(self, "Batch", ("size", "threads"))

    def plan(self, begun: Plan | None) -> Plan:
        """Choose how batches are computed; open choices are those of the begun sweep."""
        return settled(self.size, self.mode, 1, begun)

    def run(self, program: Program, batches: Iterator[tuple[range, Columns]]):
        """Yield each batch's points and outcomes, in the order in which they finish."""
        threads = self.threads or (_cores() if choices().threads else 1)
        yield from side_by_side(program.outcomes, batches, threads)


@dataclasses.dataclass(frozen=True)
class Devices:
    """Compute on all devices of this machine that JAX sees.

    Args:
        size: Points that each device computes in one call; None: 8, or 32 with "vmap". Devices wait for each other
            after each call.
        mode: As in `Batch`.

    Raises:
        ValueError: If a number is below 1, the mode is unknown, or "call".
    """

    size: int | None = None
    mode: str = "auto"

    def __post_init__(self):
        check_settings(self, "Devices", ("size",))
        if self.mode == "call":
            raise ValueError('Devices.mode must be "map", "vmap" or "auto", got "call", which runs on the host.')

    def plan(self, begun: Plan | None) -> Plan:
        """Choose how batches are computed; open choices are those of the begun sweep."""
        return settled(self.size, self.mode, jax.local_device_count(), begun)

    def run(self, program: Program, batches: Iterator[tuple[range, Columns]]):
        """Yield each batch's points and outcomes."""
        yield from side_by_side(program.outcomes, batches, 1)


def side_by_side(compute: Callable, batches: Iterator[tuple[range, Columns]], threads: int):
    """Compute batches in threads; each begins the next when it is done, so that no easy one waits for a hard one."""
    if threads == 1:
        for points, columns in batches:
            yield points, compute(columns)
        return
    pool = ThreadPoolExecutor(threads)
    running = {}
    try:
        while True:
            while len(running) < threads and (batch := next(batches, None)) is not None:
                running[pool.submit(compute, batch[1])] = batch[0]
            if not running:
                return
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield running.pop(future), future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
