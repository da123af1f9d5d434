"""Every kernel compiles for CUDA, which needs no GPU: NVRTC is in Warp's own library."""

import importlib
import pathlib

import pytest
import warp as wp

import warploom.kernels
from warploom.kernels import device  # noqa: F401  (starts Warp quietly)


def has_kernels(name):
    """Whether a module has a kernel of its own whose types are all said."""
    module = importlib.import_module(f"warploom.kernels.{name}")
    kernels = [value for value in vars(module).values() if isinstance(value, wp.Kernel)]
    return any(kernel.module.name == module.__name__ and not kernel.is_generic for kernel in kernels)


FOLDER = pathlib.Path(warploom.kernels.__file__).parent
NAMES = sorted(file.stem for file in FOLDER.glob("*.py") if file.stem != "__init__" and has_kernels(file.stem))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_module_compiles_for_cuda(name, tmp_path):
    if not wp.get_cuda_supported_archs():
        pytest.skip("this build of Warp knows no CUDA")
    wp.compile_aot_module(f"warploom.kernels.{name}", arch=80, module_dir=tmp_path, use_ptx=True)
    assert [file for file in tmp_path.iterdir() if file.suffix == ".ptx"]
