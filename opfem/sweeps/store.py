"""Folder of a resumable sweep: its inputs, and one complete file for every finished point.

Files appear by renaming, whole or not at all, under names that identify their contents, so that any number of
processes may work on one sweep.
"""

import dataclasses
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from ..io import whole_file, write_whole
from .outputs import GOOD, Label
from .plan import Plan

PLAN, POINTS, TABLE, FINISHED = "sweep.json", "points", "table.csv", "result.nc"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """One finished point.

    Attributes:
        status: How it ended.
        message: Why it failed; else empty.
        seconds: Wall time [s].
        values: Its outputs; none where the function raised.
        labels: How they are labelled.
    """

    status: str
    message: str
    seconds: float
    values: dict[str, np.ndarray]
    labels: dict[str, Label]

    @property
    def failed(self) -> bool:
        """Whether there is no result."""
        return self.status not in GOOD


class Memory:
    """Outcomes of a sweep that is not kept on disk."""

    plan = None

    def __init__(self):
        self._outcomes: dict[int, Outcome] = {}

    def begin(self, plan: Plan) -> None:
        """Do nothing: there is nothing to go on with."""

    def has(self, point: int) -> bool:
        """Return whether a point is finished."""
        return point in self._outcomes

    def write(self, point: int, outcome: Outcome) -> None:
        """Keep a finished point."""
        self._outcomes[point] = outcome

    def read(self, point: int) -> Outcome:
        """Return a finished point."""
        return self._outcomes[point]


class Folder:
    """Outcomes of a sweep in a folder, which is made if it is not there.

    Args:
        path: The folder.
        inputs: Hashes of the inputs, by name.
        keys: Hash of each point: its values and all of `inputs`.

    Attributes:
        plan: How the sweep was begun; None: it was not.

    Raises:
        ValueError: If the folder contains another sweep, or other files.
    """

    def __init__(self, path: Path, inputs: dict[str, str], keys: list[str]):
        self._folder, self._inputs, self._keys = path, inputs, keys
        self._finished: set[int] = set()
        self._points = path / POINTS
        self.plan = self._begun()

    def _begun(self) -> Plan | None:
        file = self._folder / PLAN
        if not file.exists():
            # Another process may be beginning here: its folder of points and the plan's temporary file come first.
            begun = (POINTS, PLAN, f".{file.stem}.")
            if self._folder.is_dir() and not all(found.name.startswith(begun) for found in self._folder.iterdir()):
                raise ValueError(f"{self._folder} is not empty, and holds no {PLAN}. Choose another out=.")
            return None
        try:
            record = json.loads(file.read_text(encoding="utf-8"))
            before, plan = dict(record["inputs"]), Plan(**record["execution"])
        except (ValueError, KeyError, TypeError) as cause:
            raise ValueError(f"{file} is no record of a sweep ({cause}). Choose another out=.") from cause
        changed = [name for name in {**before, **self._inputs} if before.get(name) != self._inputs.get(name)]
        if changed:
            raise ValueError(
                f"{self._folder} holds a sweep with different inputs: {', '.join(changed)}. Choose another out=, "
                "remove that folder, or go back to what it was begun with."
            )
        return plan

    def begin(self, plan: Plan) -> None:
        """Write the inputs of the sweep and its plan."""
        self._points.mkdir(parents=True, exist_ok=True)
        record = {"inputs": self._inputs, "execution": dataclasses.asdict(plan)}
        write_whole(self._folder / PLAN, (json.dumps(record, indent=2) + "\n").encode())

    def has(self, point: int) -> bool:
        """Return whether a point is finished, by this process or another; a damaged file is ignored."""
        if point not in self._finished and self._path(point).exists():
            try:
                self.read(point)
            except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
                self._path(point).unlink(missing_ok=True)
                return False
            self._finished.add(point)
        return point in self._finished

    def write(self, point: int, outcome: Outcome) -> None:
        """Write a finished point, whole or not at all."""
        record = {
            "key": self._keys[point],
            "status": outcome.status,
            "message": outcome.message,
            "seconds": outcome.seconds,
            "labels": {name: dataclasses.asdict(label) for name, label in outcome.labels.items()},
        }
        arrays: dict[str, Any] = {f"value {name}": value for name, value in outcome.values.items()}
        with whole_file(self._path(point), sum(array.nbytes for array in arrays.values())) as temporary:
            np.savez(temporary, record=json.dumps(record), **arrays)
        self._finished.add(point)

    def read(self, point: int) -> Outcome:
        """Read a finished point; zip files carry checksums, which detect damage."""
        with self._path(point).open("rb") as file, np.load(file, allow_pickle=False) as stored:
            record = json.loads(str(stored["record"]))
            if record.pop("key") != self._keys[point]:
                raise ValueError(f"{self._path(point)} holds another point.")
            values = {name.removeprefix("value "): stored[name] for name in stored.files if name != "record"}
        labels = {name: _label(fields) for name, fields in record.pop("labels").items()}
        return Outcome(values=values, labels=labels, **record)

    def _path(self, point: int) -> Path:
        return self._points / f"{self._keys[point]}.npz"


def _label(fields: dict[str, Any]) -> Label:
    dims = fields.pop("dims")
    return Label(None if dims is None else tuple(dims), **fields)
