"""Single random scenes, each unlike the next: for training and tests; alone, or several in one launch."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ...kernels.device import resolve_device
from ...kernels.raycast import LidarCast
from .arguments import check_numbers, check_whole
from .ego import mounting
from .frame import SimulatedFrame
from .furnishing import clutter, furnish, grow, populate
from .library import Library
from .sensors import LIDARS, Lidar, lidar_model
from .street import STYLES, Street, random_street
from .sweep import START_NS, caster, observe, read_frame, set_scene
from .world import World, place

__all__ = ["SceneBatch", "sample_scene", "sample_views"]

_PERIOD = 0.1  # [s]
_DRAWN = ("vlp16", "hdl32", "vlp32", "xt32", "pandar40", "hdl64", "pandar64", "pandar90", "vls128", "os1_128")
_POLISH = (0.4, 1.6)
"""Of cars that were washed in spring, and of new ones."""
_OFTEN = {"hdl64": 11.0, "pandar64": 4.0}
_workshop = threading.local()


@dataclass(frozen=True, eq=False)
class _Scene:
    """What a seed draws: a street, and where the ego vehicle stands or drives on it, and how shiny its cars are."""

    street: Street
    pose_at: Callable[[float], np.ndarray]
    polish: float


def _drawn_lidar(random: np.random.Generator) -> Lidar:
    weights = np.array([_OFTEN.get(name, 1.0) for name in _DRAWN])
    return LIDARS[_DRAWN[random.choice(len(_DRAWN), p=weights / weights.sum())]]


def _draw(random: np.random.Generator, mounting_height: float | None, turning: bool) -> _Scene:
    style = STYLES[random.choice(len(STYLES), p=[0.35, 0.3, 0.2, 0.15])]
    share = random.uniform(0.25, 0.95)
    street, plan = random_street(random, style=style, extent=(-75.0, 75.0), crossings=int(random.integers(0, 3)),
                                 banks=True)  # fmt: skip
    s, d = random.uniform(-12, 12), random.choice([-1, 1]) * random.uniform(0.8, max(1.0, plan.half_width - 1.2))
    street.block(s, d, 2.4)
    populate(street, plan, walkers=0, riders=int(random.integers(0, 7)), cars=int(random.integers(1, 11)),
             works=int(random.integers(0, 3)))  # fmt: skip
    # Cars at any angle: turning, pulling out, double parked.
    for _ in range(random.integers(2, 9)):
        street.add(
            street.car_kind(heavy=0.12), random.uniform(-55, 55), random.normal(0, 10), random.uniform(0, 2 * np.pi)
        )
    furnish(street, plan, share)
    clutter(street, plan)
    populate(street, plan, walkers=int(random.integers(3, 30)), riders=int(random.integers(0, 4)), cars=0, works=0)
    for _ in range(random.integers(0, 8)):
        kind = ("pedestrian", "cyclist", "cone", "barrier", "stander")[random.integers(5)]
        street.add(kind, random.uniform(-40, 40), random.normal(0, 8), random.uniform(0, 2 * np.pi))
    heading = (
        random.choice([0.0, np.pi]) + random.normal(0, 0.15) if random.random() < 0.75 else random.uniform(0, 2 * np.pi)
    )
    height = random.uniform(1.6, 2.1) if random.random() < 0.8 else random.uniform(1.2, 2.6)
    mount = mounting(mounting_height or height, random.normal(0, 0.012), random.normal(0, 0.01))
    speed = random.uniform(0.0, 14.0) if turning and random.random() < 0.8 else 0.0
    # Last, so that it changes nothing else of the scenes.
    grow(street, plan, random.uniform(0.1, 1.5 if style != "urban" else 0.7))

    def pose_at(t: float) -> np.ndarray:
        one = np.ones(1)
        gone = speed * t
        at_s, at_d = s + gone * np.cos(heading), d + gone * np.sin(heading)
        upright = np.zeros(1, bool)
        return place(street.ground, at_s * one, at_d * one, heading * one, 0 * one, np.ones((1, 3)), upright)[0] @ mount

    return _Scene(street, pose_at, random.uniform(*_POLISH))


def sample_scene(
    seed: int,
    lidar: str | Lidar | None = None,
    *,
    mounting_height: float | None = None,
    turning: bool = False,
    rain: float = 0.0,
    visibility: bool = False,
    device: str = "cpu",
) -> SimulatedFrame:
    """One sweep of one random scene, unlike the next: for training and tests.

    Street, traffic, clutter, the ego's place and heading, the sensor's height and tilt, all are drawn from the seed.

    Args:
        seed: Any integer ≥ 0.
        lidar: A sensor or its name; None draws one, most often one of 64 lines.
        mounting_height: Of the sensor above the ground [m]; None draws it.
        turning: Whether the sweep takes 0.1 s, in which the ego vehicle drives too; else it is taken in an instant.
        rain: How hard it rains [mm/h].
        visibility: Whether to tell how much of each object can be seen.
        device: Where rays are cast.

    Raises:
        TypeError: A number that is none.
        ValueError: No such sensor, a seed or rain below 0, or a height that is not above it.
        DeviceError: No such device.
    """
    check_whole(seed, "seed", 0)
    check_numbers({"rain": rain}, from_0=("rain",))
    if mounting_height is not None:
        check_numbers({"mounting_height": mounting_height}, above_0=("mounting_height",))
    random = np.random.default_rng([seed, 11])
    drawn = _drawn_lidar(random)
    model = drawn if lidar is None else lidar if isinstance(lidar, Lidar) else lidar_model(lidar)
    library, cast = _kept(model, rain, resolve_device(device))
    scene = _draw(random, mounting_height, turning)
    return observe(
        World(scene.street, library), cast, model, scene.pose_at, 0.0, turn=_PERIOD if turning else 0.0, seed=seed,
        index=0, version=START_NS, visibility=visibility, polish=scene.polish,
    )  # fmt: skip


def sample_views(
    seed: int, count: int, lidar: str | Lidar | None = None, *, device: str = "cpu"
) -> list[SimulatedFrame]:
    """Sweeps of one random scene, in an instant each, from `count` places at different times.

    The first is that of `sample_scene`; the others are from free places elsewhere on the street, each with a heading,
    a mounting and a sensor of its own.

    Args:
        seed: Any integer ≥ 0.
        count: How many.
        lidar: A sensor or its name; None draws one for each.
        device: Where rays are cast.

    Raises:
        TypeError: A number that is none.
        ValueError: No such sensor, a seed below 0, or no sweep asked for.
        DeviceError: No such device.
    """
    check_whole(seed, "seed", 0)
    check_whole(count, "count", 1)
    random = np.random.default_rng([seed, 11])
    drawn, device = _drawn_lidar(random), resolve_device(device)
    scene = _draw(random, None, False)
    world, frames = None, []
    random = np.random.default_rng([seed, 12])
    pose_at = scene.pose_at
    for view in range(count):
        model = drawn if lidar is None else lidar if isinstance(lidar, Lidar) else lidar_model(lidar)
        library, cast = _kept(model, 0.0, device)
        if world is None:
            world = World(scene.street, library)
        frames.append(
            observe(
                world, cast, model, pose_at, 1.5 * view, turn=0.0, seed=seed + 1_000_003 * view, index=view,
                version=START_NS + view * 1_500_000_000, visibility=False, polish=scene.polish,
            )
        )  # fmt: skip
        drawn = _drawn_lidar(random)
        pose_at = _elsewhere(random, scene.street, world, 1.5 * (view + 1))
    return frames


def _elsewhere(random: np.random.Generator, street: Street, world: World, t: float) -> Callable[[float], np.ndarray]:
    """A pose at rest on the carriageway or beside it, 2.5 m from the middle of all that is there at time t."""
    which = np.arange(len(world))
    s_all, d_all, _ = world.street_pose(which, t)
    s = d = 0.0
    for _ in range(40):
        s, d = random.uniform(-45, 45), random.normal(0, 4)
        if np.hypot(s_all - s, d_all - d).min() > 2.5 and street.free(s, d, 1.2):
            break
    heading = random.choice([0.0, np.pi]) + random.normal(0, 0.3)
    mount = mounting(random.uniform(1.4, 2.3), random.normal(0, 0.012), random.normal(0, 0.01))
    one = np.ones(1)
    pose = place(street.ground, s * one, d * one, heading * one, 0 * one, np.ones((1, 3)), np.zeros(1, bool))[0] @ mount
    return lambda _: pose


def _kept(model: Lidar, rain: float, device: str) -> tuple[Library, LidarCast]:
    """The library and the plan of a sensor that this thread keeps from scene to scene."""
    kept = _workshop.__dict__.setdefault("kept", {})
    if device not in kept:
        kept[device] = (Library(device), {})
    library, casts = kept[device]
    wetness = 1.0 if rain > 0 else 0.0
    key = (id(model), wetness)
    if key not in casts:
        casts[key] = (caster(library, model, _PERIOD, wetness=wetness), model)
    cast: LidarCast = casts[key][0]
    cast.set_rain(rain)
    return library, cast


class SceneBatch:
    """Several random scenes cast in one launch: the same frames as `sample_scene` gives one by one.

    On a GPU all beams of all scenes are threads of one launch; a CPU takes the scenes in turn.
    """

    def __init__(self, worlds: int, lidar: str | Lidar = "hdl64", *, turning: bool = False, device: str = "cpu"):
        """Takes the memory for a batch.

        Args:
            worlds: Scenes in a batch.
            lidar: The sensor of all of them, or its name.
            turning: As in `sample_scene`.
            device: Where rays are cast.

        Raises:
            TypeError: `worlds` is no whole number.
            ValueError: Fewer than one world, or no such sensor.
            DeviceError: No such device.
        """
        check_whole(worlds, "worlds", 1)
        self.lidar = lidar if isinstance(lidar, Lidar) else lidar_model(lidar)
        self.turning = turning
        self._library = Library(resolve_device(device), grounds=worlds)
        self._cast = caster(self._library, self.lidar, _PERIOD, worlds=worlds)

    def frames(self, seeds: Sequence[int], *, visibility: bool = False) -> list[SimulatedFrame]:
        """The scenes of these seeds.

        Args:
            seeds: One for each world, or fewer.
            visibility: Whether to tell how much of each object can be seen.

        Raises:
            TypeError: A seed that is no whole number.
            ValueError: More seeds than worlds, none, or one below 0.
        """
        if not 0 < len(seeds) <= self._cast.worlds:
            raise ValueError(f"seeds must be 1 to {self._cast.worlds}, not {len(seeds)}")
        for seed in seeds:
            check_whole(seed, "seed", 0)
        turn = _PERIOD if self.turning else 0.0
        scenes: list[tuple[World, Callable[[float], np.ndarray], float]] = []
        for number in range(self._cast.worlds):
            seed = int(seeds[min(number, len(seeds) - 1)])
            if number < len(seeds):
                random = np.random.default_rng([seed, 11])
                _drawn_lidar(random)  # so that the draws are those of `sample_scene`
                scene = _draw(random, None, self.turning)
                scenes.append((World(scene.street, self._library, ground=number), scene.pose_at, scene.polish))
            # Worlds without a seed of their own repeat the last one: every beam needs a scene.
            world, pose_at, polish = scenes[-1]
            set_scene(world, self._cast, pose_at, 0.0, turn=turn, seed=seed, polish=polish, number=number)
        self._cast.launch()
        return [
            read_frame(
                world, self._cast, self.lidar, pose_at, 0.0, turn=turn, index=0, version=START_NS,
                visibility=visibility, number=number,
            )
            for number, (world, pose_at, _) in enumerate(scenes)
        ]  # fmt: skip
