"""The card of a head: what its ONNX file takes, gives, was trained on and was measured to do.

A head is two files side by side: the ONNX model and a YAML card that names it. A model that does not fit its card
is refused before it runs.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, overload

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from ..errors import ModelError
from .classes import CLASSES
from .onnx_file import NotOnnxError, external_data, opset

__all__ = [
    "DEFAULT_CARD",
    "EIGHT_BITS_CARD",
    "MOST_BOXES",
    "CardPart",
    "DecodeSpec",
    "HeadCard",
    "InputSpec",
    "LidarCard",
    "ModelCard",
    "OutputSpec",
    "SecondSpec",
    "default_card",
    "file_sha256",
    "load_card",
    "named_card",
    "read_card_file",
    "read_yaml",
    "said_errors",
    "save_card",
]

DEFAULT_CARD = Path(__file__).parent / "weights" / "pillar_center.yaml"
"""The head that ships with warploom, in floating point."""

EIGHT_BITS_CARD = DEFAULT_CARD.with_name("pillar_center_int8.yaml")
"""The same in eight bits."""

_HIGHEST_OPSET = 17
_REGRESSION = ("dx", "dy", "z", "log_l", "log_w", "log_h", "cos_2yaw", "sin_2yaw", "cos_yaw", "sin_yaw")
_OVERLAP = "iou"


def _name_of_file(value: str) -> str:
    if value != Path(value).name or value in ("", ".", ".."):
        raise ValueError(f"must be the name of a file beside the card, not {value!r}")
    return value


MOST_BOXES = 1 << 15
"""That a card may ask room for: suppression compares each of them with each."""


class CardPart(BaseModel):
    """What has no keys but its own, and no numbers but finite ones."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class InputSpec(CardPart):
    """The model's one input: pillars, as `kernels.pillar.PillarGrid` makes them."""

    name: str
    shape: tuple[int, int, int, int]
    """1, C, H (along y), W (along x)."""
    channels: tuple[str, ...]
    """Names of the C channels, some of `kernels.pillar.pillar_channels` in their order."""
    point_range: tuple[float, float, float, float, float, float]
    """xmin ymin zmin xmax ymax zmax [m]; x and y about the sensor, z above the ground."""
    cell: float = Field(gt=0)
    """Edge of a cell [m]."""


class OutputSpec(CardPart):
    """The model's one output: heat maps of the classes (logits), then the box at each cell."""

    name: str
    shape: tuple[int, int, int, int]
    """1, channels, rows, columns."""
    unfold: int = Field(1, ge=1)
    """Blocks of so many by so many cells are folded into channels, see `kernels.decode.CenterDecode`."""
    regression: tuple[str, ...]
    """Names of the maps after the classes'; the last may be `iou`, see `kernels.decode.CenterDecode`."""

    @property
    def overlap(self) -> bool:
        """Whether the last map says how far each box is thought to overlap its object."""
        return self.regression[-1] == _OVERLAP

    @property
    def unfolded(self) -> tuple[int, int, int]:
        """Maps, rows, columns, once the blocks are unfolded."""
        _, channels, rows, columns = self.shape
        return channels // self.unfold**2, rows * self.unfold, columns * self.unfold

    @field_validator("regression")
    @classmethod
    def _known(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if value not in (_REGRESSION, (*_REGRESSION, _OVERLAP)):
            raise ValueError(f"this version decodes {', '.join(_REGRESSION)}, and perhaps {_OVERLAP} after them")
        return value


class DecodeSpec(CardPart):
    """From maps to boxes."""

    stride: int = Field(ge=1)
    """Input cells along an edge of an output cell."""
    score_threshold: float = Field(ge=0, le=1)
    nms_iou: float = Field(gt=0, le=1)
    """Of two boxes that overlap more than this from above, the better stays, whatever their classes."""
    overlap_weight: float = Field(0.0, ge=0, lt=1)
    """Share of the thought overlap in a score."""
    refine: tuple[str, ...] = ()
    """Classes whose boxes are turned and moved onto their points, see `kernels.box_refine`."""
    max_candidates: int = Field(ge=1, le=MOST_BOXES)
    max_objects: int = Field(ge=1, le=MOST_BOXES)


class SecondSpec(CardPart):
    """The second stage: a network that looks at the points of the first one's boxes, see `models.second_stage`."""

    file: str
    """The ONNX file, beside the card."""
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    opset: int = Field(ge=11, le=_HIGHEST_OPSET)
    points_of_box: int = Field(128, ge=1, le=4096)
    """Points that it sees of a box."""
    max_boxes: int = Field(64, ge=1, le=1024)
    """Boxes of a cloud that it looks at, those with the best scores; what remains is dropped."""
    candidate_score: float = Field(0.15, ge=0, le=1)
    """Least score of the first stage of a box that it looks at."""
    around: float = Field(0.75, ge=0)
    """By which a box is grown on its sides to have its points [m], and in height as follows."""
    over_bottom: float = 0.1
    """From how far above its bottom [m]."""
    over_top: float = 1.0
    """Up to how far above its top [m]."""
    moved: tuple[str, ...] = ()
    """Classes whose boxes are put where the second stage says; of others it says score and class alone."""
    size_shares: dict[str, float] = Field(default_factory=dict)
    """By class, how far sizes of moved boxes go from the first stage's to the second's, 0 to 1; else all the way."""
    powers: dict[str, float] = Field(default_factory=dict)
    """By class, to which power its scores are raised, so that one threshold fits all classes; else 1."""
    weights: tuple[float, float, float] = (0.4, 0.4, 0.2)
    """Exponents in a score of the first stage's, of the class's probability, and of the thought overlap."""

    @field_validator("file")
    @classmethod
    def _beside_the_card(cls, value: str) -> str:
        return _name_of_file(value)

    @field_validator("size_shares")
    @classmethod
    def _parts(cls, value: dict[str, float]) -> dict[str, float]:
        if not all(0 <= share <= 1 for share in value.values()):
            raise ValueError(f"must be from 0 to 1, not {value}")
        return value

    @field_validator("powers")
    @classmethod
    def _positive(cls, value: dict[str, float]) -> dict[str, float]:
        if not all(power > 0 for power in value.values()):
            raise ValueError(f"must be above 0, not {value}")
        return value

    @field_validator("weights")
    @classmethod
    def _shares(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if min(value) < 0 or abs(sum(value) - 1) > 1e-6:
            raise ValueError(f"must be at least 0 and add up to 1, not {value}")
        return value


class ModelCard(CardPart):
    """What every card says, whatever its network takes and gives."""

    name: str
    description: str = ""
    file: str
    """The ONNX file, beside the card."""
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    opset: int = Field(ge=11, le=_HIGHEST_OPSET)
    classes: tuple[str, ...]
    """In the order of the network."""
    training: dict[str, Any]
    """Data, seed, frames, iterations, minutes, recipe."""
    measured: dict[str, Any]
    """Figures, each with its protocol."""
    licence: str

    @field_validator("file")
    @classmethod
    def _beside_the_card(cls, value: str) -> str:
        return _name_of_file(value)

    def contradiction(self) -> str:
        """What in it does not fit together; empty: nothing."""
        return ""


class LidarCard(ModelCard):
    """A card whose network finds objects of the classes of `models.classes`."""

    @field_validator("classes")
    @classmethod
    def _classes_known(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        unknown = [name for name in value if name not in CLASSES]
        if unknown or not value:
            raise ValueError(f"no class {', '.join(map(repr, unknown)) or 'at all'}; there are: {', '.join(CLASSES)}")
        return value


class HeadCard(LidarCard):
    """The card of a pillar centre head, see `models.head`."""

    kind: Literal["pillar_center"] = "pillar_center"
    input: InputSpec
    output: OutputSpec
    decode: DecodeSpec
    second: SecondSpec | None = None

    def contradiction(self) -> str:
        """What in it does not fit together."""
        spec, low, high = self.input, self.input.point_range[:3], self.input.point_range[3:]
        if not all(a < b for a, b in zip(low, high, strict=True)):
            return f"input.point_range must be xmin ymin zmin xmax ymax zmax with min < max, not {spec.point_range}"
        columns, rows = (round((high[axis] - low[axis]) / spec.cell) for axis in (0, 1))
        wanted_in = (1, len(spec.channels), rows, columns)
        if spec.shape != wanted_in:
            return f"input.shape {spec.shape} does not follow from channels, range and cell: {wanted_in}"
        stride = self.decode.stride
        wanted_out = (len(self.classes) + len(self.output.regression), rows // stride, columns // stride)
        if self.output.unfolded != wanted_out:
            return f"output.shape {self.output.shape} does not follow from classes, regression and stride: {wanted_out}"
        if unknown := [name for name in self.decode.refine if name not in self.classes]:
            return f"decode.refine names {', '.join(unknown)}, but the classes are {', '.join(self.classes)}"
        if self.decode.overlap_weight and not self.output.overlap:
            return f"decode.overlap_weight is {self.decode.overlap_weight}, but output.regression has no {_OVERLAP}"
        if self.second is not None:
            spec = self.second
            for field, named in (("moved", spec.moved), ("size_shares", spec.size_shares), ("powers", spec.powers)):
                if unknown := [name for name in named if name not in self.classes]:
                    return f"second.{field} names {', '.join(unknown)}, but the classes are {', '.join(self.classes)}"
            if self.second.file == self.file:
                return f"second.file is the first stage's, {self.file}"
        return ""


def _check_model(path: Path, file: str, sha256: str, wanted_opset: int) -> None:
    """Refuses an ONNX file that is not the one that a card means."""
    model = path.parent / file
    if not model.is_file():
        raise ModelError(f"{path}: the card's model {model} is not there; put the ONNX file beside its card")
    found = file_sha256(model)
    if found != sha256:
        raise ModelError(
            f"{model}: its sha256 is {found}, but the card {path.name} says {sha256}; "
            "the file was changed or is another one: fetch it again, or write a card for it"
        )
    content = model.read_bytes()
    try:
        found_opset, elsewhere = opset(content), external_data(content)
    except NotOnnxError as error:
        raise ModelError(f"{model}: this is not an ONNX model: {error}") from error
    if found_opset != wanted_opset:
        raise ModelError(f"{model}: its opset is {found_opset}, but the card {path.name} says {wanted_opset}")
    if elsewhere:
        raise ModelError(f"{model}: its weights lie in other files, which the card's sha256 does not cover")


Card = TypeVar("Card", bound=ModelCard)


def default_card(device: str) -> Path:
    """The shipped head for a device: in eight bits on a CPU, where that takes half the time, else in floating point."""
    return EIGHT_BITS_CARD if device == "cpu" else DEFAULT_CARD


def named_card(card: str | Path) -> Path:
    """The path of a card: of a head that ships by its name, such as `pillar_center`, else what is given."""
    ships = {name: path for path in (DEFAULT_CARD, EIGHT_BITS_CARD) for name in (path.stem, path.name)}
    return Path(card) if Path(card).is_file() else ships.get(str(card), Path(card))


def said_errors(error: ValidationError) -> str:
    """Keys of a card that are not valid, and why, in one line."""
    return "; ".join(f"{'.'.join(map(str, each['loc'])) or 'card'}: {each['msg']}" for each in error.errors())


def file_sha256(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""libyaml's, where PyYAML was built with it: ten times as fast, but it says less of a mistake."""


def read_yaml(text: str) -> Any:
    """What plain YAML says.

    Raises:
        yaml.YAMLError: It is none.
    """
    try:
        return yaml.load(text, Loader=_LOADER)
    except yaml.YAMLError:
        return yaml.safe_load(text)


def read_card_file(path: Path) -> Any:
    """What the YAML of a card says.

    Raises:
        ModelError: It cannot be read, or is no YAML.
    """
    try:
        return read_yaml(path.read_text("utf-8"))
    except OSError as error:
        raise ModelError(
            f"{path}: cannot read the head's card: {error.strerror}; by name there are {DEFAULT_CARD.stem} and "
            f"{EIGHT_BITS_CARD.stem}"
        ) from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise ModelError(f"{path}: the card is not YAML: {error}") from error


@overload
def load_card(path: str | Path) -> tuple[HeadCard, Path]: ...


@overload
def load_card(path: str | Path, kind: type[Card]) -> tuple[Card, Path]: ...


def load_card(path: str | Path, kind: type[ModelCard] = HeadCard) -> tuple[ModelCard, Path]:
    """Reads a card and checks that its model is there, is the one it means, and that card and model agree in shape.

    Args:
        path: The YAML file, or the name of a head that ships, see `named_card`.
        kind: What kind of card it must be.

    Returns:
        The card and the path of its ONNX file.

    Raises:
        ModelError: The card is missing or not valid, or the model is missing or has another sha256 or opset.
    """
    path = named_card(path)
    content = read_card_file(path)
    kinds = get_args(kind.model_fields["kind"].annotation)
    said = content.get("kind", kinds[0]) if isinstance(content, dict) else kinds[0]
    if said not in kinds:
        raise ModelError(f"{path}: a card of the kind {said!r}; one of the kind {' or '.join(kinds)} is wanted here")
    try:
        card = kind.model_validate(content)
    except ValidationError as error:
        raise ModelError(f"{path}: the card is not valid: {said_errors(error)}") from error
    if contradiction := card.contradiction():
        raise ModelError(f"{path}: {contradiction}")
    _check_model(path, card.file, card.sha256, card.opset)
    if isinstance(card, HeadCard) and card.second is not None:
        _check_model(path, card.second.file, card.second.sha256, card.second.opset)
    return card, path.parent / card.file


def save_card(path: str | Path, card: ModelCard) -> None:
    """Writes a card as YAML."""
    content = yaml.safe_dump(card.model_dump(mode="json"), sort_keys=False, allow_unicode=True, width=120)
    Path(path).write_text(content, encoding="utf-8")
