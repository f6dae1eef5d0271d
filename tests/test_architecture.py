"""The shape of the package: who may import whom, and what no module does.

Every rule reads the source with `ast`; folders that do not exist yet are simply not there to break it.
"""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "opfem"
CHAIN = (
    "measurement",
    "model",
    "calibration",
    "mechanics",
    "solvers",
    "optimise",
    "inverse",
    "identification",
    "results",
)
EVERYONE = {"_types", "_checks", "_repr", "_device"}

MAY_IMPORT = {stage: set(CHAIN[: place + 1]) for place, stage in enumerate(CHAIN)}
MAY_IMPORT |= {
    "_types": set(),
    "_checks": set(),
    "_repr": set(),
    "_device": set(),
    "compilation": set(),
    "io": {"io", "measurement", "model", "results"},
    "plot": {"plot", "io", "measurement", "results"},
    "report": {"report", "io", "measurement", "results"},
    "datasets": {"datasets", "io", "measurement"},
    "decks": {"decks", "io", *CHAIN},
    "sweeps": {"sweeps", "io", "compilation", *CHAIN},
}
SEE_ALL = {"__init__", "__main__", "cli"}

LIBRARY_HOMES = {
    "xarray": {"results", "io", "decks", "sweeps", "plot", "report", "cli"},
    "h5py": {"io"},
    "scipy.io": {"io"},
    "tifffile": {"io"},
    "PIL": {"io"},
    "pyvista": {"io", "plot"},
    "vtk": {"io", "plot"},
    "matplotlib": {"plot"},
    "plotly": {"report"},
    "pooch": {"datasets", "compilation"},
}
MAY_CONFIGURE_JAX = {"cli", "compilation"}  # in a function that the user calls
NO_FILE_CLOCK_LOGGER = {"os", "io", "pathlib", "shutil", "tempfile", "time", "datetime", "logging"}
FORBIDDEN_NAMES = {"utils", "util", "helpers", "common", "core", "misc"}
LONGEST_MODULE = 420

MODULES = sorted(PACKAGE.rglob("*.py"))


def part_of(path: Path) -> str:
    """Name of the folder, or of the top-level module, that a file belongs to."""
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def absolute(path: Path, node: ast.ImportFrom) -> str:
    """Absolute name of the module that a `from` import names."""
    if node.level == 0:
        return node.module or ""
    package = list(path.relative_to(ROOT).parts[:-1])
    base = package[: len(package) - node.level + 1]
    return ".".join([*base, *([node.module] if node.module else [])])


def imports(path: Path) -> set[str]:
    """Every dotted name that a file imports, anywhere in it; `from a import b` counts as a and a.b."""
    names: set[str] = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = absolute(path, node)
            names |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return names


def parts_imported(path: Path) -> set[str]:
    """Parts of opfem that a file imports; a name taken from the package's root counts by that name."""
    own = {name.split(".")[1] for name in imports(path) if name.startswith("opfem.")}
    if any(
        isinstance(node, ast.Import) and any(a.name == "opfem" for a in node.names) for node in ast.walk(tree_of(path))
    ):
        own.add("opfem")
    return own


def dotted(node: ast.AST) -> str:
    """`a.b.c` of an attribute expression, else an empty string."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        base = dotted(node.value)
        return f"{base}.{node.attr}" if base else ""
    return ""


def names_used(path: Path) -> set[str]:
    """Every plain name, attribute and part of an import in a file."""
    names = {part for name in imports(path) for part in name.split(".")}
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Name):
            names.add(node.id)
        elif isinstance(node, ast.Attribute):
            names.add(node.attr)
    return names


def imports_library(path: Path, library: str) -> bool:
    return any(name == library or name.startswith(f"{library}.") for name in imports(path))


def located(paths: list[Path]) -> list[str]:
    return [str(path.relative_to(ROOT)) for path in paths]


def test_package_is_there():
    assert any(part_of(path) == "measurement" for path in MODULES)


def test_every_part_has_a_place_in_the_design():
    known = set(MAY_IMPORT) | SEE_ALL
    assert [path for path in located(MODULES) if part_of(ROOT / path) not in known] == []


def test_stages_import_only_what_they_may():
    wrong = [
        f"{path.relative_to(ROOT)} imports opfem.{other}"
        for path in MODULES
        if part_of(path) not in SEE_ALL
        for other in sorted(parts_imported(path) - MAY_IMPORT.get(part_of(path), set()) - EVERYONE)
    ]
    assert wrong == []


@pytest.mark.parametrize(("library", "homes"), LIBRARY_HOMES.items())
def test_library_stays_in_its_home(library, homes):
    assert located([p for p in MODULES if part_of(p) not in homes and imports_library(p, library)]) == []


def test_chain_touches_no_file_clock_or_logger():
    stages = set(CHAIN[1:])
    wrong = [
        f"{path.relative_to(ROOT)} imports {library}"
        for path in MODULES
        if part_of(path) in stages
        for library in sorted(NO_FILE_CLOCK_LOGGER)
        if imports_library(path, library)
    ]
    assert wrong == []


def test_chain_opens_no_file():
    opened = [
        path
        for path in MODULES
        if part_of(path) in CHAIN[1:]
        and any(isinstance(node, ast.Call) and dotted(node.func) == "open" for node in ast.walk(tree_of(path)))
    ]
    assert located(opened) == []


def test_no_nameless_modules():
    named = {part for path in MODULES for part in path.relative_to(PACKAGE).with_suffix("").parts}
    assert {name for name in named if name.strip("_") in FORBIDDEN_NAMES} == set()


def test_modules_hold_one_idea():
    lengths = {str(p.relative_to(ROOT)): len(p.read_text(encoding="utf-8").splitlines()) for p in MODULES}
    assert {path: lines for path, lines in lengths.items() if lines > LONGEST_MODULE} == {}


def test_modules_open_with_a_docstring():
    assert located([p for p in MODULES if p.stat().st_size and ast.get_docstring(tree_of(p)) is None]) == []


def test_jax_is_not_configured_at_import():
    """Only the command line may configure JAX, and only inside a function."""

    def at_import(tree: ast.AST) -> list[ast.AST]:
        found, queue = [], [tree]
        while queue:
            node = queue.pop()
            found.append(node)
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
                queue.extend(ast.iter_child_nodes(node))
        return found

    def configures(nodes: list[ast.AST]) -> bool:
        return any(isinstance(node, ast.Attribute) and dotted(node) == "jax.config" for node in nodes)

    wrong = [
        path
        for path in MODULES
        if configures(at_import(tree_of(path)))
        or (
            part_of(path) not in MAY_CONFIGURE_JAX
            and (configures(list(ast.walk(tree_of(path)))) or "jax.config" in imports(path))
        )
    ]
    assert located(wrong) == []


@pytest.mark.parametrize("name", ["custom_vjp", "_src"])
def test_name_is_not_used(name):
    """custom_vjp has no forward derivative, which the traction fit needs; jax._src is private."""
    assert located([p for p in MODULES if name in names_used(p)]) == []


ALL_BUT_PICTURES = "import opfem; [getattr(opfem, name) for name in dir(opfem) if not name.startswith('plot')]; "


def run(code: str) -> str:
    return subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()


def test_import_loads_only_what_is_asked_for():
    found = "print(*sorted({'jax', 'numpy', 'xarray', 'opfem.model'} & set(sys.modules)))"
    assert run(f"import sys, opfem, opfem.cli; {found}") == ""
    assert run(f"import sys, opfem; opfem.Layer; {found}") == "jax numpy opfem.model"


def test_import_loads_no_plotting_library():
    found = "print(*sorted({'matplotlib', 'pyvista', 'vtk', 'vtkmodules'} & set(sys.modules)))"
    assert run(f"import sys; {ALL_BUT_PICTURES} {found}") == ""


def test_import_leaves_jax_configuration_alone():
    compare = "print(before == jax.config.jax_enable_x64)"
    assert run(f"import jax; before = jax.config.jax_enable_x64; {ALL_BUT_PICTURES} {compare}") == "True"


def test_public_names_are_listed_and_there():
    import opfem

    names = dir(opfem)
    assert {"Layer", "solve", "sweep", "plot_pressure", "datasets", "__version__"} <= set(names)
    assert all(getattr(opfem, name) is not None for name in names)
    assert callable(opfem.sweep)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = opfem.nothing
    assert (PACKAGE / "py.typed").is_file()


def test_options_of_the_command_line_are_those_of_the_library():
    """The command line states them again, so that its help need not load JAX."""
    from typing import get_args

    from opfem.cli import options
    from opfem.model.palpation import ELEMENTS

    assert get_args(options.Element) == ELEMENTS
    assert set(get_args(options.Hexahedron)) == {name for name in ELEMENTS if not name.startswith("tet")}


class TestRules:
    """The rules themselves catch what they should."""

    def write(self, folder: Path, monkeypatch, text: str) -> Path:
        monkeypatch.setattr(sys.modules[__name__], "ROOT", folder)
        monkeypatch.setattr(sys.modules[__name__], "PACKAGE", folder / "opfem")
        path = folder / "opfem" / "model" / "layer.py"
        path.parent.mkdir(parents=True)
        path.write_text(text, encoding="utf-8")
        return path

    @pytest.mark.parametrize(
        ("text", "part"),
        [
            ("from opfem.solvers import solve", "solvers"),
            ("def f():\n    import opfem.io.thickness", "io"),
            ("from ..results import fields", "results"),
            ("from opfem import plot", "plot"),
            ("import opfem as op", "opfem"),
            ("from .mesh import Mesh", "model"),
        ],
    )
    def test_imports_are_seen(self, tmp_path, monkeypatch, text, part):
        assert parts_imported(self.write(tmp_path, monkeypatch, text)) == {part}

    @pytest.mark.parametrize("text", ["import scipy.io", "from scipy import io", "from scipy.io import loadmat"])
    def test_libraries_are_seen(self, tmp_path, monkeypatch, text):
        path = self.write(tmp_path, monkeypatch, text)
        assert imports_library(path, "scipy.io")
        assert not imports_library(path, "io")

    @pytest.mark.parametrize("text", ["import jax\n@jax.custom_vjp\ndef f(x): ...", "from jax import custom_vjp"])
    def test_names_are_seen(self, tmp_path, monkeypatch, text):
        assert "custom_vjp" in names_used(self.write(tmp_path, monkeypatch, text))
