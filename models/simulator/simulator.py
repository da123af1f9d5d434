"""The simulator: a LiDAR driven along a procedural street, with ground truth, and single random scenes."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...kernels.device import resolve_device
from ...kernels.raycast import LidarCast
from .furnishing import furnish, populate
from .labels import GROUND_CLASSES, material_table
from .library import Library, object_class, prototype
from .sensors import LIDARS, Lidar, lidar_model
from .street import STYLES, Street, phase_of, random_street, travelled
from .terrain import Ground

__all__ = ["SCENARIOS", "SimulatedFrame", "Simulator", "sample_scene"]

SCENARIOS = ("street",)
"""What `Simulator` can drive through."""

_START_NS = 1_700_000_000_000_000_000
_EGO = -1
# Things that stand upright whatever the slope; the others lie on the ground with all wheels.
_UPRIGHT = {"pedestrian", "stander", "tree", "facade", "lamp_post", "sign", "bollard", "bus_stop", "hydrant"}


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedFrame:
    """One sweep with everything that is true of it; boxes and velocities along the axes of the cloud."""

    version: int
    """Time of the sweep [ns]."""
    index: int
    """Number of the frame, from 0."""
    points: np.ndarray
    """x forward, y left, z up [m] in the sensor's frame, intensity 0 to 1; shape (n, 4), float32."""
    ring: np.ndarray
    """Laser of each point, lowest first, shape (n,), uint16."""
    t: np.ndarray
    """Time of each point after `version` [s], shape (n,), float32."""
    point_class: np.ndarray
    """`PointClass` of each point, shape (n,), int32."""
    instance: np.ndarray
    """Id of the object a point is on, −1 for background; shape (n,), int64."""
    ground: np.ndarray
    """True on road, sidewalk and terrain, shape (n,), bool."""
    boxes: np.ndarray
    """Centre x y z, length width height [m], yaw [rad] of every object in range, tight to it; (k, 7), float32."""
    classes: np.ndarray
    """Indices into `models.classes.CLASSES`, shape (k,), int32."""
    ids: np.ndarray
    """The same object has the same id in every frame, from 1; shape (k,), int64."""
    velocities: np.ndarray
    """Over ground, along the cloud's x and y [m/s]; shape (k, 2), float32."""
    counts: np.ndarray
    """Points on each object, 0 where it is hidden; shape (k,), int32."""
    pose: np.ndarray
    """World from sensor, shape (4, 4), float64."""
    speed: float
    """Of the ego vehicle over ground [m/s]."""
    lidar: str
    """Name of the sensor."""


class _World:
    """A furnished street as the ray caster needs it: transforms of all things at a time."""

    def __init__(self, street: Street, library: Library):
        things = street.things
        self.ground = street.ground
        self.library = library
        self.kind = things.kind
        self.variant = np.array(things.variant, np.int64)
        self.pose = np.array(things.pose, np.float64).reshape(-1, 4)
        self.scale = np.array(things.scale, np.float64).reshape(-1, 3)
        self.motion = np.array(things.motion, np.float64).reshape(-1, 4)
        self.classes = np.array([object_class(kind) for kind in things.kind], np.int32)
        self.upright = np.array([kind in _UPRIGHT for kind in things.kind], bool)
        self.objects = np.flatnonzero(self.classes >= 0)
        self.ids = np.full(len(self.kind), -1, np.int64)
        self.ids[self.objects] = 1 + np.arange(len(self.objects))
        self.start = street.random.random(len(self.kind))
        self.moves = self.motion[:, 0] != 0
        self.animated = np.array([k in ("pedestrian", "cyclist") for k in self.kind], bool)
        library.meshes.replace(library.ground, *self.ground.mesh())
        self._mesh = np.array(
            [library.number(k, int(v)) for k, v in zip(self.kind, self.variant, strict=True)], np.int64
        )
        self._still = self._transforms(np.arange(len(self.kind)), 0.0)

    def street_pose(self, which: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """s, d and yaw against the street of things at time t."""
        gone = travelled(self.motion[which], t)
        s, d, yaw, _ = self.pose[which].T
        return s + gone * np.cos(yaw), d + gone * np.sin(yaw), yaw

    def _transforms(self, which: np.ndarray, t: float) -> np.ndarray:
        s, d, yaw = self.street_pose(which, t)
        return place(self.ground, s, d, yaw, self.pose[which, 3], self.scale[which], self.upright[which])

    def at(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mesh, transform and phase of everything at time t."""
        mesh, transforms = self._mesh.copy(), self._still.copy()
        phases = np.zeros(len(self.kind), np.int64)
        moving = np.flatnonzero(self.moves)
        if len(moving):
            transforms[moving] = self._transforms(moving, t)
        gone = travelled(self.motion, t)
        for k in np.flatnonzero(self.animated):
            phases[k] = phase_of(self.kind[k], gone[k], self.start[k])
            mesh[k] = self.library.number(self.kind[k], int(self.variant[k]), int(phases[k]))
        return mesh, transforms, phases

    def velocity(self, t: float) -> np.ndarray:
        """World velocity of all things, shape (k, 3): central differences of their exact paths."""
        h = 1e-3
        velocity = np.zeros((len(self.kind), 3))
        moving = np.flatnonzero(self.moves)
        if len(moving):
            velocity[moving] = (
                self._transforms(moving, t + h)[:, :3, 3] - self._transforms(moving, t - h)[:, :3, 3]
            ) / (2 * h)
        return velocity


def place(
    ground: Ground,
    s: np.ndarray,
    d: np.ndarray,
    yaw: np.ndarray,
    lift: np.ndarray,
    scale: np.ndarray,
    upright: np.ndarray,
) -> np.ndarray:
    """World from local of things on the ground, shape (k, 4, 4); those not upright follow its slope."""
    x, y, bend = ground.to_world(s, d)
    z = ground.height(s, d) + lift
    along, across = ground.slope(s, d)
    along, across = np.where(upright, 0.0, along), np.where(upright, 0.0, across)
    heading = yaw + bend
    c, sn = np.cos(heading), np.sin(heading)
    # Rise along and across the street, as rise along the world's axes.
    gx = along * np.cos(bend) - across * np.sin(bend)
    gy = along * np.sin(bend) + across * np.cos(bend)
    forward = np.stack([c, sn, gx * c + gy * sn], 1)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    up = np.stack([-gx, -gy, np.ones_like(gx)], 1)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    left = np.cross(up, forward)
    transforms = np.zeros((len(s), 4, 4))
    transforms[:, :3, :3] = np.stack([forward, left, up], 2) * scale[:, None, :]
    transforms[:, :3, 3] = np.stack([x, y, z], 1)
    transforms[:, 3, 3] = 1.0
    return transforms


def _mounting(height: float, pitch: float, roll: float) -> np.ndarray:
    """Vehicle from sensor."""
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]) @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    pose[2, 3] = height
    return pose


def _boxes(
    world: _World, which: np.ndarray, transforms: np.ndarray, phases: np.ndarray, pose: np.ndarray
) -> np.ndarray:
    """The tight upright box of each object in the sensor's frame, shape (k, 7)."""
    inverse = np.linalg.inv(pose)
    boxes = np.empty((len(which), 7), np.float32)
    for row, k in enumerate(which):
        local = inverse @ transforms[k]
        forward = local[:3, 0]
        yaw = np.arctan2(forward[1], forward[0])
        hull = prototype(world.kind[k], int(world.variant[k]), int(phases[k])).hull @ local[:3, :3].T + local[:3, 3]
        c, s = np.cos(yaw), np.sin(yaw)
        turned = np.stack([hull[:, 0] * c + hull[:, 1] * s, hull[:, 1] * c - hull[:, 0] * s, hull[:, 2]], 1)
        low, high = turned.min(0), turned.max(0)
        x, y, z = 0.5 * (low + high)
        boxes[row] = x * c - y * s, x * s + y * c, z, *(high - low), yaw
    return boxes


def _observe(
    world: _World,
    cast: LidarCast,
    lidar: Lidar,
    pose: np.ndarray,
    t: float,
    *,
    seed: int,
    index: int,
    speed: float,
    far: float,
) -> SimulatedFrame:
    """Casts one sweep into the world at time t and gathers what is true of it."""
    mesh, transforms, phases = world.at(t)
    everything = np.concatenate([np.eye(4)[None], transforms])
    cast.place(np.concatenate([[world.library.ground], mesh]), everything)
    cast.aim(pose, seed=seed)
    cast.launch()
    n = int(cast.count.numpy()[0])
    owner = cast.point_instance.numpy()[:n] - 1
    instance = np.where(owner >= 0, world.ids[np.maximum(owner, 0)], -1)
    point_class = cast.point_class.numpy()[:n].copy()
    which = world.objects
    apart = np.linalg.norm(transforms[which, :2, 3] - pose[:2, 3], axis=1)
    which = which[apart < far]
    counts = np.bincount(owner[owner >= 0], minlength=len(world.kind))[which]
    velocity = world.velocity(t)[which] @ pose[:3, :3]
    return SimulatedFrame(
        version=_START_NS + index * 100_000_000,
        index=index,
        points=cast.points.numpy()[:n].copy(),
        ring=cast.point_ring.numpy()[:n].copy(),
        t=cast.point_time.numpy()[:n].copy(),
        point_class=point_class,
        instance=instance,
        ground=np.isin(point_class, GROUND_CLASSES),
        boxes=_boxes(world, which, transforms, phases, pose),
        classes=world.classes[which],
        ids=world.ids[which],
        velocities=velocity[:, :2].astype(np.float32),
        counts=counts.astype(np.int32),
        pose=pose,
        speed=speed,
        lidar=lidar.name,
    )


def _caster(library: Library, lidar: Lidar, period: float) -> LidarCast:
    beams, ring, fraction = lidar.beams
    cast = LidarCast(
        meshes=library.meshes,
        beams=beams,
        ring=ring,
        time=fraction * period,
        period=period,
        min_range=lidar.min_range,
        max_range=lidar.max_range,
        reach=lidar.reach,
        range_noise=lidar.range_noise,
        drop_out=lidar.drop_out,
    )
    cast.set_materials(material_table())
    return cast


class Simulator:
    """A drive along a simulated street; iterating gives its frames, the same ones each time."""

    def __init__(
        self,
        seed: int = 0,
        scenario: str = "street",
        lidar: str | Lidar = "hdl64",
        mounting_height: float = 1.73,
        duration: float = 10.0,
        rate: float = 10.0,
        device: str = "cpu",
    ):
        """Builds the world.

        Args:
            seed: Chooses the street and everything on it.
            scenario: One of `SCENARIOS`.
            lidar: A sensor, or the name of one of `sensors.LIDARS`.
            mounting_height: Of the sensor above the ground [m].
            duration: Of the drive [s].
            rate: Sweeps a second.
            device: Where rays are cast.

        Raises:
            ValueError: No such scenario or sensor, or a length of time that is not positive.
            DeviceError: No such device.
        """
        if scenario not in SCENARIOS:
            raise ValueError(f"scenario must be one of {', '.join(SCENARIOS)}, not {scenario!r}")
        for name, value in (("duration", duration), ("rate", rate), ("mounting_height", mounting_height)):
            if not value > 0:
                raise ValueError(f"{name} must be > 0, not {value}")
        self.seed, self.rate, self.duration = seed, rate, duration
        self.mounting_height = mounting_height
        self.lidar = lidar_model(lidar) if isinstance(lidar, str) else lidar
        library = Library(resolve_device(device))
        random = np.random.default_rng([seed, 7])
        self._ego_motion = np.array([8.0, 1.2, 0.45, 0.0])
        street = self._street(random)
        self._world = _World(street, library)
        self._cast = _caster(library, self.lidar, 1.0 / rate)
        self._running = threading.Lock()

    def _street(self, random: np.random.Generator) -> Street:
        ahead = 8.0 * self.duration
        street, plan = random_street(
            random, style=STYLES[self.seed % 2], extent=(-90.0, ahead + 100.0), duration=self.duration, crossings=2,
            hilly=0.6, parking=(True, True), sidewalk=3.6, half_width=6.2,
        )  # fmt: skip
        lane = 1.75
        ego = tuple(float(v) for v in self._ego_motion)
        street.keep_clear(street.track(np.array([4.8, 2.0, 1.7]), 0.0, -lane, 0.0, ego, 0.3))
        self._lane = -lane
        add = street.add
        for kind, s, d, yaw, speed in (
            ("sedan", 17.0, -lane, 0.0, 8.3), ("hatch", -16.0, -lane, 0.0, 7.8), ("van", 38.0, -lane, 0.0, 8.6),
            ("suv", 55.0, lane, np.pi, 8.5), ("wagon", 80.0, lane, np.pi, 8.0), ("hatch", 105.0, lane, np.pi, 8.4),
            ("truck", 135.0, lane, np.pi, 7.5), ("mini", 160.0, lane, np.pi, 8.2), ("bus", -45.0, -lane, 0.0, 7.5),
        ):  # fmt: skip
            add(kind, s, d, yaw, motion=(speed, 0.8, 0.5, random.uniform(0, 6.3)))
        for _ in range(6):
            add("pedestrian", ahead + random.uniform(12, 40), random.choice([-1, 1]) * plan.half_width,
                np.pi / 2 * random.choice([-1, 1]), motion=(random.uniform(0.9, 1.5), 0.05, 2.0, 0.0))  # fmt: skip
        populate(street, plan, walkers=60, riders=10, cars=0, works=2)
        furnish(street, plan, 0.75)
        populate(street, plan, walkers=30, riders=0, cars=0, works=0)
        return street

    def __len__(self) -> int:
        return max(1, round(self.duration * self.rate))

    def __iter__(self) -> Iterator[SimulatedFrame]:
        return (self.frame(index) for index in range(len(self)))

    @property
    def ground(self) -> Ground:
        """The height field under the street."""
        return self._world.ground

    def pose(self, t: float) -> np.ndarray:
        """World from sensor at time t [s], shape (4, 4)."""
        gone = travelled(self._ego_motion, t)
        one = np.ones(1)
        vehicle = place(
            self._world.ground, gone * one, self._lane * one, 0 * one, 0 * one, np.ones((1, 3)), np.zeros(1, bool)
        )
        return vehicle[0] @ _mounting(self.mounting_height, 0.0, 0.0)

    def frame(self, index: int) -> SimulatedFrame:
        """The frame of this number; any order does.

        Raises:
            IndexError: There is no such frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"index must be 0 to {len(self) - 1}, not {index}")
        t = index / self.rate
        speed = np.linalg.norm(self.pose(t + 1e-3)[:3, 3] - self.pose(t - 1e-3)[:3, 3]) / 2e-3
        with self._running:
            frame = _observe(
                self._world, self._cast, self.lidar, self.pose(t), t,
                seed=self.seed * 1_000_003 + index, index=index, speed=float(speed), far=self.lidar.max_range,
            )  # fmt: skip
        version = _START_NS + round(index * 1e9 / self.rate)
        return frame if version == frame.version else SimulatedFrame(**{**frame.__dict__, "version": version})


_workshop = threading.local()


def sample_scene(seed: int, lidar: str | Lidar | None = None, *, device: str = "cpu") -> SimulatedFrame:
    """One sweep of one random scene, unlike the next: for training and tests.

    Street, traffic, clutter, the ego's place and heading, the sensor's height and tilt, all are drawn from the seed.

    Args:
        seed: Any integer ≥ 0.
        lidar: A sensor or its name; None draws one, most often one of 64 lines.
        device: Where rays are cast.
    """
    random = np.random.default_rng([seed, 11])
    names = list(LIDARS)
    weights = np.array([6.0 if LIDARS[n].lines == 64 else 1.0 for n in names])
    drawn = names[random.choice(len(names), p=weights / weights.sum())]
    model = lidar if isinstance(lidar, Lidar) else lidar_model(lidar or drawn)
    device = resolve_device(device)
    kept = _workshop.__dict__.setdefault("kept", {})
    if device not in kept:
        kept[device] = (Library(device), {})
    library, casts = kept[device]
    if model.name not in casts:
        casts[model.name] = _caster(library, model, 0.1)

    style = STYLES[random.choice(len(STYLES), p=[0.35, 0.3, 0.2, 0.15])]
    share = random.uniform(0.25, 0.95)
    street, plan = random_street(
        random, style=style, extent=(-75.0, 75.0), crossings=int(random.integers(0, 3)), parked=share
    )
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
    populate(street, plan, walkers=int(random.integers(3, 30)), riders=int(random.integers(0, 4)), cars=0, works=0)
    for _ in range(random.integers(0, 8)):
        kind = ("pedestrian", "cyclist", "cone", "barrier", "stander")[random.integers(5)]
        street.add(kind, random.uniform(-40, 40), random.normal(0, 8), random.uniform(0, 2 * np.pi))
    world = _World(street, library)
    heading = (
        random.choice([0.0, np.pi]) + random.normal(0, 0.15) if random.random() < 0.75 else random.uniform(0, 2 * np.pi)
    )
    one = np.ones(1)
    vehicle = place(street.ground, s * one, d * one, heading * one, 0 * one, np.ones((1, 3)), np.zeros(1, bool))[0]
    height = random.uniform(1.6, 2.1) if random.random() < 0.8 else random.uniform(1.2, 2.6)
    pose = vehicle @ _mounting(height, random.normal(0, 0.012), random.normal(0, 0.01))
    return _observe(world, casts[model.name], model, pose, 0.0, seed=seed, index=0, speed=0.0, far=model.max_range)
