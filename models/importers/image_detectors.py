"""YOLOX and FastestDet, whose authors publish ONNX files: a copy of the file and a card make a head of it."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...errors import ModelError
from ..camera.card import BoxReadSpec, ImageDetectorCard, ImageSpec, TensorName
from ..camera.coco import COCO_CLASSES
from ..card import file_sha256, load_card, save_card
from ..onnx_file import NotOnnxError, opset

__all__ = ["import_fastestdet", "import_yolox"]


def import_yolox(
    model: str | Path,
    folder: str | Path,
    *,
    classes: Sequence[str] = COCO_CLASSES,
    name: str = "yolox",
    score_threshold: float = 0.3,
    licence: str = "Apache-2.0",
) -> Path:
    """Makes a head of an ONNX file of YOLOX that gives its grids undecoded, as its `export_onnx.py` writes it.

    Args:
        model: The file.
        folder: Where the copy and the card go.
        classes: In the order of the network.
        name: Of the head.
        score_threshold: For the card.
        licence: Of the weights.

    Returns:
        The path of the card, which `ImageDetector` takes.

    Raises:
        ModelError: The file cannot be loaded, or is of another network.
    """
    return _import(model, folder, classes, name, "yolox", (8, 16, 32), score_threshold, 0.45, licence)


def import_fastestdet(
    model: str | Path,
    folder: str | Path,
    *,
    classes: Sequence[str] = COCO_CLASSES,
    name: str = "fastestdet",
    score_threshold: float = 0.5,
    licence: str = "BSD-3-Clause",
) -> Path:
    """Makes a head of an ONNX file of FastestDet; see `import_yolox`."""
    return _import(model, folder, classes, name, "fastestdet", (16,), score_threshold, 0.45, licence)


def _import(
    model: str | Path,
    folder: str | Path,
    classes: Sequence[str],
    name: str,
    kind: Any,
    strides: tuple[int, ...],
    score_threshold: float,
    nms_iou: float,
    licence: str,
) -> Path:
    model, folder = Path(model), Path(folder)
    (source, shape), (target, result) = _shapes(model)
    if len(shape) != 4 or shape[:2] != (1, 3) or len(result) not in (3, 4):
        raise ModelError(f"{model}: its input {shape} and output {result} are not those of a {kind}")
    letterbox = kind == "yolox"
    folder.mkdir(parents=True, exist_ok=True)
    copy = folder / f"{name}.onnx"
    card = ImageDetectorCard(
        name=name,
        kind=kind,
        description=f"{kind}, imported from {model.name}.",
        file=copy.name,
        sha256=file_sha256(model),
        opset=opset(model.read_bytes()),
        input=ImageSpec(
            name=source,
            shape=(1, 3, *shape[2:]),
            scale=1.0 if letterbox else 1.0 / 255.0,
            fit="letterbox" if letterbox else "stretch",
        ),
        output=TensorName(name=target, shape=result),
        read=BoxReadSpec(score_threshold=score_threshold, nms_iou=nms_iou, strides=strides),
        classes=tuple(classes),
        training={"imported_from": model.name},
        measured={},
        licence=licence,
    )
    path = folder / f"{name}.yaml"
    if contradiction := card.contradiction():
        raise ModelError(f"{model}: not a {kind} of {len(classes)} classes: {contradiction}")
    if model.resolve() != copy.resolve():
        shutil.copyfile(model, copy)
    save_card(path, card)
    load_card(path, ImageDetectorCard)
    return path


def _shapes(model: Path) -> list[tuple[str, tuple[int, ...]]]:
    """Name and shape of the one input and the one output."""
    import onnxruntime as ort

    try:
        opset(model.read_bytes())
        options = ort.SessionOptions()
        options.log_severity_level = 4
        session = ort.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
    except OSError as error:
        raise ModelError(f"{model}: {error.strerror}") from error
    except NotOnnxError as error:
        raise ModelError(f"{model}: this is not an ONNX model: {error}") from error
    except Exception as error:  # ONNX Runtime has a family of exceptions of its own, not all of them public
        raise ModelError(f"{model}: ONNX Runtime cannot load it: {error}") from error
    nodes = [*session.get_inputs(), *session.get_outputs()]
    if len(nodes) != 2 or any(not isinstance(n, int) for node in nodes for n in node.shape):
        said = [(node.name, node.shape) for node in nodes]
        raise ModelError(f"{model}: expected one input and one output of fixed shape, got {said}")
    return [(node.name, tuple(node.shape)) for node in nodes]
