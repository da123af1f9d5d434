"""The walls of the house: which room may import which, and what `import warploom` may cost."""

import ast
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent
ROOMS = ("kernels", "models", "datamesh", "dag", "components")
# A room may import itself, the leaf `errors`, and these.
ALLOWED = {
    "kernels": set(),
    "models": {"kernels"},
    "datamesh": set(),
    "dag": {"datamesh"},
    "components": {"kernels", "models", "datamesh", "dag"},
}
HEAVY = (
    "torch",
    "taichi",
    "onnxruntime",
    "rerun",
    "zenoh",
    "ray",
    "cv2",
    "open3d",
    "warp",
    "numpy",
    "scipy",
    "pydantic",
)


def imported_rooms(path: pathlib.Path) -> set[tuple[int, str]]:
    """Line and room of each import of a room in a file, relative or absolute."""
    package = path.relative_to(ROOT).parts[:-1]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - node.level + 1]
            names = [".".join((*base, *(node.module or "").split(".")))] if node.module else []
            names += [".".join((*base, alias.name)) for alias in node.names] if not node.module else []
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module.removeprefix("warploom.")] if node.module.startswith("warploom") else []
        elif isinstance(node, ast.Import):
            names = [a.name.removeprefix("warploom.") for a in node.names if a.name.startswith("warploom")]
        for name in names:
            room = name.split(".")[0]
            if room in (*ROOMS, "cli", "bench", "tests"):
                found.add((node.lineno, room))
    return found


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_the_rooms_below_it(room):
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {other}"
        for path in sorted((ROOT / room).rglob("*.py"))
        for line, other in sorted(imported_rooms(path))
        if other != room and other not in ALLOWED[room]
    ]
    assert not wrong, "\n".join(wrong)


def test_every_room_is_checked_and_has_files():
    for room in ROOMS:
        assert list((ROOT / room).rglob("*.py")), room


def test_import_warploom_loads_no_heavy_library():
    code = f"import sys, warploom; print([m for m in {HEAVY!r} if m in sys.modules])"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd="/").stdout
    assert output.strip() == "[]"


def test_importing_the_kernels_loads_no_training_or_inference_library():
    heavy = ("torch", "taichi", "onnxruntime", "cv2")
    code = f"import sys, warploom as wl; wl.cluster; wl.read; print([m for m in {heavy!r} if m in sys.modules])"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd="/").stdout
    assert output.strip() == "[]"
