"""Taichi's one runtime of a process: starts it, quietly and with arithmetic as Warp's, and allocates on its device.

Where no arch is named it is the CPU, with all its threads, or what Taichi's own variable `TI_ARCH` says, such as
`vulkan`. Compiled kernels are kept where Taichi keeps them, or in the folder `TI_OFFLINE_CACHE_FILE_PATH`: processes
that run at the same time may share it, since Taichi locks it, and one that finds it locked compiles for itself.

On a CPU, Taichi's own threads take denormal numbers for zero.
"""

import contextlib
import io
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
import taichi as ti
import warp as wp
from taichi.lang import impl

from ...errors import DeviceError
from ..device import DEFAULT_DEVICE
from ..interop import Points, adopt, give

__all__ = ["DEFAULT_TAICHI", "check_count", "give_back", "has_64_bits", "launching", "rows_of", "start", "workspace"]

DEFAULT_TAICHI = "taichi"
_ARCHS = ("cpu", "vulkan", "metal", "cuda")
_CPU_ARCHS = ("x64", "arm64")
_NEEDS = {
    "vulkan": "it needs a GPU whose driver speaks Vulkan 1.1 or newer, and Vulkan's loader (on Debian and Ubuntu "
    "libvulkan1, and mesa-vulkan-drivers for AMD and Intel); `vulkaninfo --summary` of vulkan-tools lists what is",
    "metal": "it needs a Mac",
    "cuda": "it needs an NVIDIA GPU and its driver; `nvidia-smi` lists what is there",
}
"""What has to be there for an arch."""

launching = threading.RLock()
"""Held while a kernel is launched, since Taichi's runtime serves one thread at a time."""

_program: Any = None


def start(device: str = DEFAULT_TAICHI, threads: int | None = None) -> str:
    """Starts Taichi if nobody has, and says on which device it computes.

    Args:
        device: `taichi:cpu`, `taichi:vulkan`, `taichi:metal` or `taichi:cuda`; `taichi` alone is the one that is
            running, or else the default.
        threads: Of the CPU; all by default. Heeded only by the call that starts Taichi.

    Returns:
        The device's full name.

    Raises:
        ValueError: No name of a device.
        DeviceError: Taichi cannot compute there, runs on another device already, or was started by someone else with
            arithmetic too loose for these kernels.
    """
    global _program
    library, _, arch = device.partition(":")
    if library != DEFAULT_TAICHI or (arch not in _ARCHS and arch != ""):
        names = ", ".join(f"'taichi:{name}'" for name in _ARCHS)
        raise ValueError(f"device must be 'taichi' or one of {names}, not {device!r}")
    with launching:
        running = impl.get_runtime().prog
        if running is None and _program is None:
            _initialise(arch or "cpu", threads)
            running = _program = impl.get_runtime().prog
        elif _program is None:
            if impl.current_cfg().fast_math or not impl.get_runtime().short_circuit_operators:
                raise DeviceError(
                    "Taichi runs already, with fast_math or without short_circuit_operators, which changes results: "
                    "start it with taichi.init(fast_math=False), or call warploom first and let it start Taichi"
                )
            _program = running
        elif running is not _program:
            raise DeviceError(
                "Taichi has been reset (taichi.init or taichi.reset) since it computed for warploom, and with it "
                "went warploom's workspaces; start it once, before the first call"
            )
        name = f"{DEFAULT_TAICHI}:{_arch_name()}"
    if arch and name != f"{DEFAULT_TAICHI}:{arch}":
        raise DeviceError(f"Taichi computes on one device in a process, here already on {name!r}, so not on {device!r}")
    return name


def _initialise(arch: str, threads: int | None) -> None:
    # In a thread of its own: Taichi makes the thread that starts it flush denormal numbers to zero from then on, and
    # what NumPy and Warp compute must not change by that.
    with ThreadPoolExecutor(1) as starter:
        started = starter.submit(_run_taichi, arch, {} if threads is None else {"cpu_max_num_threads": threads})
    try:
        started.result()
    except RuntimeError as error:
        needs = f"; {_NEEDS[arch]}" if arch in _NEEDS else ""
        raise DeviceError(f"Taichi cannot compute on 'taichi:{arch}' here: {error}{needs}") from error


@ti.kernel
def _count_in_loops(counts: ti.types.ndarray(dtype=ti.i32, ndim=1)):
    # 256 to each of four, for a look at the driver.
    for block in range(16):
        for i in range(block * 64, (block + 1) * 64):
            ti.atomic_add(counts[i & 3], 1)


def _run_taichi(arch: str, options: dict[str, int]) -> None:
    with contextlib.redirect_stdout(io.StringIO()):  # it greets
        ti.init(
            arch=getattr(ti, arch),
            enable_fallback=False,
            default_fp=ti.f32,
            default_ip=ti.i32,
            # As in the Warp kernels: which cell a point falls into must not hang on what a compiler fuses.
            fast_math=False,
            log_level=ti.CRITICAL,  # what goes wrong is raised
            **options,
        )
    # What only the thread that has started it can do; kernels may then be launched by any.
    impl.get_runtime().materialize()
    if _arch_name() != "cpu":
        counts = np.zeros(4, np.int32)
        _count_in_loops(counts)
        if counts.tolist() != [256] * 4:
            ti.reset()
            raise RuntimeError("its driver loses atomic additions in loops, as Mesa's lavapipe 22.3 does")


def _arch_name() -> str:
    name = ti._lib.core.arch_name(impl.current_cfg().arch)
    return "cpu" if name in _CPU_ARCHS else name


@ti.kernel
def _count_in_64_bits(number: ti.i32) -> ti.i32:
    return ti.i32(ti.i64(ti.f64(number) * 0.5) + 1)


@cache
def has_64_bits() -> bool:
    """Whether the running device has 64-bit floats and integers: Apple's GPUs, for one, have not."""
    with launching:
        try:
            return _count_in_64_bits(4) == 3
        except RuntimeError:  # so Taichi's compiler says that it has not
            return False


def workspace(shape: int | tuple[int, ...], dtype: Any) -> ti.Ndarray:
    """An array on Taichi's device, zero."""
    array = ti.ndarray(dtype, shape)
    array.fill(0)
    return array


def check_count(count: int, points: Any, capacity: int) -> None:
    """Raises a ValueError where `count` is more than there are points, or than the plan's capacity."""
    most = min(points.shape[0], capacity)
    if not 0 <= count <= most:
        raise ValueError(
            f"count must be 0 … {most}, with {points.shape[0]} rows and a capacity of {capacity}, not {count}"
        )


def rows_of(points: Points) -> np.ndarray:
    """The borrowed table as Taichi takes it: on the host, contiguous, with at least one row."""
    rows = points.table.numpy()
    if not len(rows):
        return np.zeros((1, points.table.shape[1]), np.float32)
    return np.ascontiguousarray(rows)


def give_back(host: np.ndarray, points: Points) -> Any:
    """A fresh array of the host as one of the family, and on the device, of the points that were borrowed."""
    if points.device == DEFAULT_DEVICE:
        return adopt(host, points.family)
    return give(wp.array(host, device=points.device), points.family)
