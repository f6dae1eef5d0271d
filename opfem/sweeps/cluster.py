"""`Cluster`: points of a sweep on the workers of a `dask.distributed` client that exists already.

Workers compute, this process writes: they need no common disk. Another worker repeats the batches of a lost one.
"""

import dataclasses
import hashlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

from ..compilation import configuration, configure
from .execution import Columns, Program
from .outputs import ERROR, Outputs
from .plan import Plan, check_settings, settled
from .store import Outcome

# Batches under way for each thread of a worker: one that runs, one that waits.
_AHEAD = 2


@dataclasses.dataclass(frozen=True)
class Cluster:
    """Compute on the workers of a dask client.

    `Client(LocalCluster(n_workers=2, threads_per_worker=1))` makes one on this machine, dask-jobqueue's `SLURMCluster`
    one from jobs of a queue. Each worker compiles once.

    Args:
        client: A `dask.distributed.Client`; install `opfem[cluster]`.
        size: As in `Batch`.
        mode: As in `Batch`.

    Raises:
        ValueError: If the client is none, the size is below 1 or the mode is unknown.
    """

    client: Any
    size: int | None = None
    mode: str = "auto"

    def __post_init__(self):
        check_settings(self, "Cluster", ("size",))
        if not callable(getattr(self.client, "submit", None)) or not hasattr(self.client, "scheduler_info"):
            raise ValueError(
                f"Cluster.client must be a dask.distributed.Client, got {type(self.client).__name__}. "
                'Install it with pip install "opfem[cluster]".'
            )

    def plan(self, begun: Plan | None) -> Plan:
        """Choose how batches are computed; open choices are those of the begun sweep."""
        return settled(self.size, self.mode, 1, begun)

    def run(
        self, fn: Callable, outputs: Outputs, plan: Plan, batches: Iterator[tuple[range, Columns]]
    ) -> Iterator[tuple[range, list[Outcome]]]:
        """Yield each batch's points and outcomes, in the order in which they finish."""
        import cloudpickle  # comes with dask
        from distributed import as_completed

        content = cloudpickle.dumps((configuration(), cloudpickle.dumps((fn, outputs, plan))))
        token = hashlib.sha256(content).hexdigest()
        # A separate task, so that it is sent once, and repeated where its worker is lost.
        task = self.client.submit(bytes, content, key=f"opfem-sweep-{token}")
        running = {}

        def begin():
            batch = next(batches, None)
            if batch is None:
                return None
            future = self.client.submit(_compute, task, token, batch[1], pure=False)
            running[future.key] = batch[0]
            return future

        threads = max(sum(self.client.nthreads().values()), 1)
        first = [future for future in (begin() for _ in range(_AHEAD * threads)) if future is not None]
        completed = as_completed(first)
        try:
            for future in completed:
                points = running.pop(future.key)
                failure = future.exception()
                yield points, future.result() if failure is None else [_lost(failure)] * len(points)
                if (another := begin()) is not None:
                    completed.add(another)
        finally:
            self.client.cancel([task, *completed.futures])


def _lost(cause: BaseException) -> Outcome:
    return Outcome(ERROR, f"{type(cause).__name__}: {cause}"[:300], float("nan"), {}, {})


_COMPILING = threading.Lock()
_PROGRAMS: dict[str, Program] = {}


def _compute(content: bytes, token: str, columns: Columns) -> list[Outcome]:
    """Run one batch on a worker; it keeps the program that it compiled last."""
    import cloudpickle

    with _COMPILING:
        if token not in _PROGRAMS:
            settings, function = cloudpickle.loads(content)
            configure(settings)  # first: arrays that the function captured lose digits where 64 bits are off
            fn, outputs, plan = cloudpickle.loads(function)
            _PROGRAMS.clear()
            _PROGRAMS[token] = Program(fn, outputs, plan, columns)
        program = _PROGRAMS[token]
    return program.outcomes(columns)
