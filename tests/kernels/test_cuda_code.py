"""Every kernel compiles for CUDA, which needs no GPU: NVRTC is in Warp's own library."""

import importlib
import pathlib

import pytest
import warp as wp

import warploom.kernels
from warploom.kernels import device  # noqa: F401  (starts Warp quietly)

FOLDER = pathlib.Path(warploom.kernels.__file__).parent


def modules_of(name):
    """The Warp modules of a file that have kernels whose types are all said: its own, and one for what stands apart."""
    python_name = f"warploom.kernels.{name}"
    module = importlib.import_module(python_name)
    kernels = [value for value in vars(module).values() if isinstance(value, wp.Kernel) and not value.is_generic]
    return sorted({k.module.name for k in kernels if k.module.name in (python_name, f"{python_name}.apart")})


FILES = sorted(file.stem for file in FOLDER.glob("*.py") if file.stem != "__init__")
NAMES = [name for file in FILES for name in modules_of(file)]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_module_compiles_for_cuda(name, tmp_path):
    if not wp.get_cuda_supported_archs():
        pytest.skip("this build of Warp knows no CUDA")
    wp.compile_aot_module(wp.get_module(name), arch=80, module_dir=tmp_path, use_ptx=True)
    assert [file for file in tmp_path.iterdir() if file.suffix == ".ptx"]
