"""The state of a long explicit solve in one file, so that a killed run goes on where it was.

Written at every output, whole or not at all; tied to its inputs by their hash.
"""

import dataclasses
import os
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..results.provenance import inputs_hash
from .atomic import whole_file

_HASH = "inputs_sha256"


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A file that keeps the state of an explicit solve: `Explicit(checkpoint=Checkpoint("run.npz"))`.

    The same call after an interruption goes on from the last output and gives the same bits as an uninterrupted run.
    The file stays when the solve is done; delete it when it is no longer wanted.

    Args:
        path: An .npz file; its folder must exist.

    Raises:
        ValueError: If the path does not end in .npz.
    """

    path: str | os.PathLike

    def __post_init__(self):
        if Path(self.path).suffix != ".npz":
            raise ValueError(f"Checkpoint.path must end in .npz, got {os.fspath(self.path)!r}.")

    def keep(self, inputs: Any, state: Any) -> None:
        """Replace the file by this state.

        Args:
            inputs: Inputs of the solve.
            state: Any PyTree of arrays.
        """
        arrays: dict[str, Any] = {f"leaf_{k}": np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves(state))}
        with whole_file(self.path, sum(array.nbytes for array in arrays.values())) as temporary:
            np.savez(temporary, **{_HASH: np.array(inputs_hash(inputs=inputs)), **arrays})

    def restore(self, inputs: Any, like: Any) -> Any:
        """Read the state; None where there is no file.

        Args:
            inputs: Inputs of the solve.
            like: A state of the same structure, shapes and types.

        Raises:
            ValueError: If the file belongs to other inputs, or is damaged.
        """
        path = Path(self.path)
        if not path.is_file():
            return None
        leaves, structure = jax.tree.flatten(like)
        try:
            # Opened here, because np.load leaves the file open when the archive is damaged.
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                known = str(stored[_HASH])
                arrays = [stored[f"leaf_{k}"] for k in range(len(leaves))]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as cause:
            raise ValueError(f"{path} is no checkpoint, or damaged: {cause}. Delete it to start anew.") from cause
        if known != inputs_hash(inputs=inputs):
            raise ValueError(f"{path} belongs to other inputs. Delete it, or take another file.")
        expected = [(np.shape(leaf), np.asarray(leaf).dtype) for leaf in leaves]
        if [(array.shape, array.dtype) for array in arrays] != expected:
            raise ValueError(f"{path} holds another state than this version of opfem keeps. Delete it to start anew.")
        return structure.unflatten([jnp.asarray(array) for array in arrays])
