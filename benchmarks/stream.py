"""What the machine can do at best: bytes read and floating-point operations per second, on all cores.

Run `python benchmarks/stream.py`. Prints one JSON line per figure. Other benchmarks call `read_bandwidth` in
their own run and give their figures as shares of it: on a shared machine seconds do not hold, ratios do.
"""

import json
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

# Far larger than any cache.
_BYTES = 512 * 2**20
_MATRIX = 2048


def best_seconds(work: Callable[[], object], repeats: int = 10) -> float:
    """Time a piece of work; the fastest of several runs is the one least disturbed."""
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begin)
    return min(seconds)


def cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0))


def read_bandwidth(dtype: type = np.float64) -> float:
    """Measure how fast all cores together read memory [byte/s]: each sums its part of one large array."""
    parts = np.array_split(np.ones(_BYTES // np.dtype(dtype).itemsize, dtype), cores())
    with ThreadPoolExecutor(cores()) as pool:
        return _BYTES / best_seconds(lambda: list(pool.map(np.sum, parts)))


def flop_rate(dtype: type = np.float64) -> float:
    """Measure how many operations per second the matrix product of the BLAS library does."""
    a = np.ones((_MATRIX, _MATRIX), dtype)
    return 2 * _MATRIX**3 / best_seconds(lambda: a @ a, 5)


def main() -> None:
    for dtype in (np.float64, np.float32):
        name = np.dtype(dtype).name
        print(json.dumps({"figure": "read bandwidth", "dtype": name, "GB_per_s": read_bandwidth(dtype) / 1e9}))
        print(json.dumps({"figure": "matrix product", "dtype": name, "Gflop_per_s": flop_rate(dtype) / 1e9}))


if __name__ == "__main__":
    main()
