"""A network of an ONNX file at work in ONNX Runtime, bound to buffers of ours: nothing is allocated or copied in a run.

A provider is where it computes: `cpu`, `cuda` or `tensorrt`. They are tried in the order wanted; what is missing falls
back to the next, and `fallback` says so.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from ..errors import ModelError
from ..kernels.arguments import whole
from .onnx_file import with_batch

__all__ = [
    "PRECISIONS",
    "PROVIDERS",
    "Network",
    "TensorSpec",
    "provider_settings",
    "said_fallback",
    "wanted_providers",
]

_log = logging.getLogger(__name__)

PROVIDERS = ("cpu", "cuda", "tensorrt")
"""Where a network can compute."""

PRECISIONS = ("fp32", "tf32", "fp16")
"""What a network on a GPU can compute in; a CPU computes in what the file says."""

_NAMES = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider", "tensorrt": "TensorrtExecutionProvider"}
_SHORT = {name: short for short, name in _NAMES.items()}
_TYPES = {"tensor(float)": np.dtype(np.float32), "tensor(int32)": np.dtype(np.int32)}

TensorSpec = Mapping[str, tuple[int | None, ...]]
"""Shapes of inputs or outputs by name, in order; None: any length."""


def wanted_providers(precision: str, gpu: bool) -> tuple[str, ...]:
    """The providers in the order in which they are tried, where nobody says otherwise."""
    if not gpu:
        return ("cpu",)
    return ("tensorrt", "cuda", "cpu") if precision == "fp16" else ("cuda", "cpu")


def provider_settings(name: str, precision: str, ordinal: int, stream: int) -> str | tuple[str, dict[str, Any]]:
    """A provider with its options as ONNX Runtime takes them: on a GPU it computes on Warp's stream."""
    if name == "cpu":
        return _NAMES[name]
    shared = {"device_id": ordinal, "user_compute_stream": str(stream)}
    if name == "tensorrt":
        return _NAMES[name], {**shared, "trt_fp16_enable": precision == "fp16"}
    return _NAMES[name], {**shared, "use_tf32": int(precision != "fp32")}


def said_fallback(wanted: Sequence[str], used: str, precision: str) -> str:
    """What is missing and what became of it; empty where the first choice is used."""
    if wanted[0] == used:
        return ""
    missing = wanted[: wanted.index(used)] if used in wanted else wanted
    lesser = ", in tf32 in place of fp16" if used == "cuda" and precision == "fp16" else ""
    return f"no provider {', '.join(missing)} here: the network runs on {used}{lesser}"


class Network:
    """A network, checked against what its card says and ready to be bound.

    Args:
        model: The ONNX file.
        inputs: As the card has them.
        outputs: As the card has them.
        device: A Warp device: of the arrays that are bound.
        threads: CPU threads.
        precision: On a GPU, one of `PRECISIONS`; fp16 needs the provider tensorrt.
        providers: Of `PROVIDERS`, the best first; None: what the device has, then the CPU.
        batch: Inputs to run at once, where the card's shapes begin with 1.
        classes: As the card has them; refused where the model was stamped with others.

    Attributes:
        provider: Where it computes, one of `PROVIDERS`.
        fallback: Empty where that is the first choice; else what is missing and what became of it, for people.
        batch: How many inputs a run takes.

    Raises:
        ModelError: The file cannot be loaded or does not fit its card, or none of the providers is there.
        ValueError: No such provider or precision, or fewer than one thread.
    """

    def __init__(
        self,
        model: Path,
        inputs: TensorSpec,
        outputs: TensorSpec,
        *,
        device: str = "cpu",
        threads: int = 2,
        precision: str = "fp32",
        providers: Sequence[str] | None = None,
        batch: int = 1,
        classes: Sequence[str] | None = None,
    ):
        if whole(threads, "threads") < 1:
            raise ValueError(f"threads must be at least 1, not {threads}")
        if precision not in PRECISIONS:
            raise ValueError(f"precision must be one of {', '.join(PRECISIONS)}, not {precision!r}")
        if providers is not None and (isinstance(providers, str) or not providers or set(providers) - set(PROVIDERS)):
            raise ValueError(f"providers must be some of {', '.join(PROVIDERS)}, in a list, not {providers!r}")
        self.device, self.batch = device, batch
        self._stream = None if device == "cpu" else wp.get_stream(device)
        self._session, self.provider, self.fallback = self._load(model, threads, precision, providers)
        if self.fallback:
            _log.warning("%s: %s", model.name, self.fallback)
        self._check(model, inputs, outputs, classes)
        self._outputs = tuple(outputs)
        self._binding = self._session.io_binding()
        self._staged: dict[str, tuple[wp.array, wp.array]] = {}
        self._run_options = self._options_of_a_run()

    def _load(self, model: Path, threads: int, precision: str, providers: Sequence[str] | None) -> tuple[Any, str, str]:
        import onnxruntime as ort

        options = ort.SessionOptions()
        options.intra_op_num_threads = int(threads)
        options.inter_op_num_threads = 1
        # A thread that waits by spinning takes a core from the stages that run beside the head.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        available = ort.get_available_providers()
        gpu = self.device != "cpu"
        wanted = wanted_providers(precision, gpu) if providers is None else tuple(providers)
        there = [name for name in wanted if _NAMES[name] in available and (name == "cpu" or gpu)]
        if not there:
            raise ModelError(
                f"{model}: none of the providers {', '.join(wanted)} is there for device {self.device}; this ONNX "
                f"Runtime has {', '.join(_SHORT.get(name, name) for name in available)}: add cpu to fall back on it"
            )
        place = (wp.get_device(self.device).ordinal, self._stream.cuda_stream) if self._stream else (0, 0)
        content = with_batch(model.read_bytes(), self.batch) if self.batch > 1 else str(model)
        try:
            session = ort.InferenceSession(
                content, options, providers=[provider_settings(name, precision, *place) for name in there]
            )
        except Exception as error:  # ONNX Runtime has a family of exceptions of its own, not all of them public
            raise ModelError(f"{model}: ONNX Runtime cannot load it: {error}") from error
        used = _SHORT.get(session.get_providers()[0], session.get_providers()[0])
        return session, used, said_fallback(wanted, used, precision)

    def _options_of_a_run(self) -> Any:
        import onnxruntime as ort

        options = ort.RunOptions()
        if self.provider != "cpu":
            # What follows is on the same stream; the host has nothing to wait for here.
            options.add_run_config_entry("disable_synchronize_execution_providers", "1")
        return options

    def _check(self, model: Path, inputs: TensorSpec, outputs: TensorSpec, classes: Sequence[str] | None) -> None:
        """Refuses a model that is not as its card says."""
        for kind, spec, nodes in (
            ("input", inputs, self._session.get_inputs()),
            ("output", outputs, self._session.get_outputs()),
        ):
            found = {node.name: tuple(node.shape) for node in nodes}
            wanted = {name: self._batched(shape) for name, shape in spec.items()}
            fits = list(found) == list(wanted) and all(
                len(found[name]) == len(shape)
                and all(b is None or a == b or not isinstance(a, int) for a, b in zip(found[name], shape, strict=True))
                for name, shape in wanted.items()
            )
            if not fits or any(node.type not in _TYPES for node in nodes):
                said = [(node.name, tuple(node.shape), node.type) for node in nodes]
                raise ModelError(f"{model}: its {kind} is {said}, but the card says {list(wanted.items())}")
        stamped = self._session.get_modelmeta().custom_metadata_map.get("classes")
        if classes is not None and stamped is not None and stamped != ",".join(classes):
            raise ModelError(f"{model}: its classes are {stamped}, but the card says {','.join(classes)}")

    def _batched(self, shape: tuple[int | None, ...]) -> tuple[int | None, ...]:
        return (self.batch, *shape[1:]) if self.batch > 1 and shape and shape[0] == 1 else shape

    @property
    def on_device(self) -> bool:
        """Whether it computes where the arrays are, so that they are bound as they lie."""
        return self.device == "cpu" or self.provider != "cpu"

    def bind_input(self, name: str, array: wp.array) -> None:
        """Makes an array, contiguous, what the network reads, until it is bound anew; read where it lies."""
        self._bind(self._binding.bind_input, name, array, into=False)

    def bind_output(self, name: str, array: wp.array) -> None:
        """Makes an array, contiguous, what the network writes."""
        self._bind(self._binding.bind_output, name, array, into=True)

    def _bind(self, bind: Any, name: str, array: wp.array, *, into: bool) -> None:
        place, ordinal = ("cpu", 0) if self.provider == "cpu" else ("cuda", wp.get_device(self.device).ordinal)
        bound = array
        if not self.on_device:
            bound = wp.zeros(array.shape, dtype=array.dtype, device="cpu")
            self._staged[name] = (bound, array) if not into else (array, bound)
        bind(name, place, ordinal, wp.dtype_to_numpy(array.dtype), tuple(array.shape), bound.ptr)

    def run(self) -> None:
        """Computes the outputs from the inputs; on a GPU in order with what is on Warp's stream, without a wait."""
        current = None if self._stream is None else wp.get_stream(self.device)
        if self._stream is None or current is None:
            self._session.run_with_iobinding(self._binding, self._run_options)
            return
        if not self.on_device:
            for target, source in self._staged.values():
                if target.device.is_cpu:
                    wp.copy(target, source)
            wp.synchronize_stream(current)
            self._session.run_with_iobinding(self._binding, self._run_options)
            for target, source in self._staged.values():
                if source.device.is_cpu:
                    wp.copy(target, source)
            return
        if current.cuda_stream != self._stream.cuda_stream:
            self._stream.wait_stream(current)
        self._session.run_with_iobinding(self._binding, self._run_options)
        if current.cuda_stream != self._stream.cuda_stream:
            current.wait_stream(self._stream)
