"""Damaged OCT files: each is read as what it says, or refused in one line.

Run `python -m benchmarks.oct_mutations [--files 10000] [--seed 0]`. Files are those of `write_oct`, volumes and raw
spectra, .oct as it is and compressed, and .h5, and a TIFF stack of myOCT, with bytes changed, cut out, put in or cut
off, and with numbers and names of the header replaced.
Chunks run in processes of their own with limited memory, so that a crash is seen. Prints one JSON line.
"""

import argparse
import json
import re
import resource
import subprocess
import sys
import tempfile
import time
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
import tifffile

import opfem as op

CHUNK = 500
MEMORY = 3 * 2**30  # bytes that reading may take: 2 GB is the largest array that is unpacked
SECONDS = 5.0
ODD = (
    "-1",
    "0",
    "1e400",
    "nan",
    "",
    "x",
    "99999999999",
    "4294967296",
    "2147483647",
    "0.5",
    "<b/>",
    "&lt;",
    "../../etc",
)
DOCTYPE = '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa">' + "".join(
    f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefgh", "bcdefghi", strict=True)
) + "]>"  # fmt: skip


def originals(folder: Path) -> dict[str, bytes]:
    """Write small files to damage."""
    rng = np.random.default_rng(0)
    real = rng.normal(20.0, 5.0, (3, 5, 16)).astype(np.float32)
    counts = rng.integers(0, 4000, (4, 6, 32)).astype(np.uint16)
    volumes: dict[str, op.OctVolume | op.Spectra] = {
        "spectra": op.Spectra(counts, 0.01, 5e-3, wavelength=845e-6),
        "repeats": op.Spectra(counts, 0.01, 5e-3, repeats=(2, 3)),
        "real": op.OctVolume(real, (0.01, 0.02), 2.5e-3, "db", wavelength=845e-6),
        "complex": op.OctVolume((real + 1j * real[::-1]).astype(np.complex64), 0.01, 2.5e-3, "complex", phase_sign=1),
    }
    for name, volume in volumes.items():
        op.write_oct(volume, folder / f"{name}.oct")
        op.write_oct(volume, folder / f"{name}.h5")
        with (
            zipfile.ZipFile(folder / f"{name}.oct") as old,
            zipfile.ZipFile(folder / f"{name}_packed.oct", "w", zipfile.ZIP_DEFLATED) as new,
        ):
            for info in old.infolist():
                new.writestr(info.filename, old.read(info))
    said = {axis: {"units": "mm", "values": [0.0, 0.01, 0.02]} for axis in "xyz"}
    with tifffile.TiffWriter(folder / "myoct.tif") as file:
        for page in counts:
            described = json.dumps({"metadata": said, "clim": [0, 60], "version": 3})
            file.write(page, software=described, metadata=None, contiguous=False)
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def damaged_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    """Change, cut out, put in or cut off bytes."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 6)):
        at = int(rng.integers(len(data)))
        kind = rng.integers(5)
        if kind == 0:
            data[at] = int(rng.integers(256))
        elif kind == 1:
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 2:
            del data[at : at + int(rng.integers(1, 64))]
        elif kind == 3:
            data[at:at] = rng.bytes(int(rng.integers(1, 64)))
        elif len(data) > 100 and rng.random() < 0.3:
            del data[at:]
        if not data:
            data = bytearray(b"\0")
    return bytes(data)


def damaged_header(content: bytes, rng: np.random.Generator, path: Path) -> bytes:
    """Write a container again with another header."""
    path.write_bytes(content)
    with zipfile.ZipFile(path) as old:
        entries = {info.filename: (old.read(info), info.compress_type) for info in old.infolist()}
    header = entries["Header.xml"][0].decode()
    for _ in range(rng.integers(1, 4)):
        kind = rng.integers(6)
        if kind == 0:
            found = list(re.finditer(r'"[^"]*"', header))
            one = found[int(rng.integers(len(found)))]
            header = header[: one.start()] + f'"{rng.choice(ODD)}"' + header[one.end() :]
        elif kind == 1:
            found = list(re.finditer(r">[^<>]+<", header))
            one = found[int(rng.integers(len(found)))]
            header = header[: one.start()] + f">{rng.choice(ODD)}<" + header[one.end() :]
        elif kind == 2:
            header = header.replace("<Ocity", DOCTYPE + "<Ocity", 1)
        elif kind == 3:
            at = int(rng.integers(len(header)))
            header = header[:at] + header[at + int(rng.integers(1, 40)) :]
        elif kind == 4:
            header = header.replace("<Image", "<a>" * int(rng.integers(1, 3000)) + "<Image", 1)
        else:
            header = re.sub(r"(<DataFile .*?</DataFile>)", r"\1\1", header, count=1)
        if not re.search(r'"[^"]*"', header) or not re.search(r">[^<>]+<", header):
            break
    with zipfile.ZipFile(path, "w") as new:
        for name, (data, packing) in entries.items():
            new.writestr(name, header if name == "Header.xml" else data, packing)
    return path.read_bytes()


def child(seed: int, first: int, count: int) -> None:
    """Read a chunk of damaged files; print what came of each kind."""
    endings: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "originals").mkdir()
        files = list(originals(folder / "originals").items())
        resource.setrlimit(resource.RLIMIT_DATA, (_size() + MEMORY, -1))
        for index in range(first, first + count):
            rng = np.random.default_rng([seed, index])
            name, content = files[index % len(files)]
            by_header = name.endswith(".oct") and rng.random() < 0.5
            path = folder / f"damaged{Path(name).suffix}"
            path.write_bytes(damaged_header(content, rng, path) if by_header else damaged_bytes(content, rng))
            begin = time.perf_counter()
            ending = _ending(path)
            if time.perf_counter() - begin > SECONDS:
                ending = "slow"
            endings[ending] += 1
            if ending not in ("read", "refused"):
                endings[f"file {index} ({name}): {ending}"] += 1
    print(json.dumps(endings))


def _ending(path: Path) -> str:
    try:
        volume = op.read_oct(path, index_applied=1.0 if path.suffix == ".tif" else None)
        volume.intensity().sum()
    except op.MeasurementError as refusal:
        said = str(refusal)
        return "refused" if said.startswith(str(path)) and "\n" not in said and len(said) < 1000 else f"said: {said}"
    except Exception as cause:
        return f"{type(cause).__name__}: {cause}"
    return "read" if volume.values.nbytes < path.stat().st_size * 1100 else "larger than the file can hold"


def _size() -> int:
    return 1024 * int(re.search(r"VmData:\s+(\d+)", Path("/proc/self/status").read_text())[1])  # type: ignore[index]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--child", type=int, nargs=2)
    chosen = parser.parse_args()
    if chosen.child:
        child(chosen.seed, *chosen.child)
        return
    total: Counter[str] = Counter()
    for first in range(0, chosen.files, CHUNK):
        count = min(CHUNK, chosen.files - first)
        command = [sys.executable, "-m", "benchmarks.oct_mutations", "--seed", str(chosen.seed), "--child"]
        done = subprocess.run([*command, str(first), str(count)], capture_output=True, text=True, timeout=600)
        if done.returncode:
            total[f"chunk from {first} ended with {done.returncode}: {done.stderr[-300:]}"] += 1
        else:
            total.update(json.loads(done.stdout))
    print(json.dumps({"files": chosen.files, "seed": chosen.seed, **total}))


if __name__ == "__main__":
    main()
