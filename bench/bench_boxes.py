"""Kernels on boxes and rays beside their peers: box fits, overlaps, suppression, ray casting."""

import numpy as np
import pytest
import warp as wp

from warploom.bench.contest import contenders, on_device, peer, processors
from warploom.bench.scans import REAL, terrain_mesh
from warploom.kernels.boxes import FitBoxes, fit_boxes
from warploom.kernels.cluster import cluster
from warploom.kernels.ground import segment_ground
from warploom.kernels.interop import borrow, borrow_points, count_on
from warploom.kernels.iou import RotatedIou, rotated_iou_bev
from warploom.kernels.nms import RotatedNms, rotated_nms
from warploom.kernels.raycast import LidarCast, MeshSet, raycast
from warploom.models.simulator.labels import Material, PointClass, face_label, material_table
from warploom.models.simulator.sensors import lidar_model

BOXES = 1000
THRESHOLD = 0.3


# ---- boxes of clusters


def opencv_boxes(points, labels):
    """A minimum-area rectangle per cluster, one call each, with the extent in z."""
    cv2 = peer("cv2", "opencv-python-headless")

    def call():
        order = np.argsort(labels, kind="stable")
        order = order[np.searchsorted(labels[order], 0) :]
        starts = np.flatnonzero(np.diff(labels[order], prepend=-1))
        boxes = np.empty((len(starts), 7), np.float32)
        for row, members in enumerate(np.split(order, starts[1:])):
            (x, y), (length, width), angle = cv2.minAreaRect(points[members, :2])
            low, high = points[members, 2].min(), points[members, 2].max()
            boxes[row] = x, y, (low + high) / 2, length, width, high - low, np.deg2rad(angle)
        return boxes

    return call


def areas(ours, theirs):
    wide = theirs[:, 3:5].min(axis=1) > 0.1  # ours are never narrower
    ratio = (ours[wide, 3] * ours[wide, 4]) / (theirs[wide, 3] * theirs[wide, 4])
    return f"{len(ours)} boxes; area over the least: median {np.median(ratio):.3f}, max {ratio.max():.3f}"


@pytest.mark.parametrize("contender", contenders("opencv"))
@pytest.mark.parametrize("scan", ["street 120k", REAL])
@pytest.mark.parametrize("method", ["l_shape", "min_area"])
def bench_fit_boxes(contest, contender, method, scan):
    whole = contest.cloud(scan)
    points = np.ascontiguousarray(whole[~segment_ground(whole).mask])
    labels = cluster(points, 0.5, 10)

    def plan(device):
        cloud = borrow_points(on_device(points, device))
        clusters, owner = borrow(on_device(labels, device), wp.int32, (len(points),), "labels")
        count = count_on(len(points), device)
        made = FitBoxes(capacity=len(points), max_clusters=int(labels.max()) + 1, method=method, device=device)

        def call():
            made.launch(cloud.xyz, clusters, count)
            return owner

        return call

    def function(device):
        given, given_labels = on_device(points, device), on_device(labels, device)
        return lambda: fit_boxes(given, given_labels, method=method)

    calls = {"warploom": function, "warploom plan": plan, "opencv": lambda _: opencv_boxes(points, labels)}
    contest.run(
        contender, calls, kernel=f"fit_boxes {method}", on=f"clusters of {scan}", size=int(labels.max()) + 1,
        agree=areas, goals={"opencv": 1 / 2},
    )  # fmt: skip


# ---- overlaps


@pytest.fixture(scope="module")
def boxes():
    """A thousand boxes with scores, several around each of two hundred places, as a head gives them."""
    random = np.random.default_rng(7)
    places = random.uniform(-50, 50, (BOXES // 5, 2)).repeat(5, axis=0)
    made = np.empty((BOXES, 7), np.float32)
    made[:, :2] = places + random.normal(0, 0.5, places.shape)
    made[:, 2] = random.normal(-1, 0.2, BOXES)
    made[:, 3:6] = random.normal((4.2, 1.8, 1.6), 0.2, (BOXES, 3))
    made[:, 6] = random.uniform(-np.pi, np.pi, BOXES // 5).repeat(5) + random.normal(0, 0.1, BOXES)
    return made, (1 + random.permutation(BOXES)).astype(np.float32) / BOXES


def corners(boxes):
    """Corners seen from above, shape (n, 4, 2)."""
    half = boxes[:, None, 3:5].astype(np.float64) / 2 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    c, s = np.cos(boxes[:, 6:7]), np.sin(boxes[:, 6:7])
    turned = np.stack([half[..., 0] * c - half[..., 1] * s, half[..., 0] * s + half[..., 1] * c], -1)
    return turned + boxes[:, None, :2]


def shapely_iou(boxes):
    """Every overlap, vectorised: an STRtree finds the pairs."""
    shapely = peer("shapely")

    def call():
        polygons = shapely.polygons(corners(boxes))
        a, b = shapely.STRtree(polygons).query(polygons)
        shared, area = shapely.area(shapely.intersection(polygons[a], polygons[b])), shapely.area(polygons)
        iou = np.zeros((len(boxes), len(boxes)))
        iou[a, b] = shared / (area[a] + area[b] - shared)
        return iou

    return call


def shapely_nms(boxes, scores):
    """Greedy suppression on those overlaps."""
    overlaps = shapely_iou(boxes)

    def call():
        iou, order = overlaps(), np.argsort(-scores, kind="stable")
        gone, kept = np.zeros(len(boxes), bool), []
        for i in order:
            if not gone[i]:
                kept.append(i)
                gone |= iou[i] > THRESHOLD
        return np.array(kept)

    return call


def opencv_nms(boxes, scores):
    cv2 = peer("cv2", "opencv-python-headless")
    if not hasattr(cv2, "dnn"):
        pytest.skip("this opencv has no NMSBoxesRotated")

    def call():
        rectangles = [((x, y), (l, w), np.rad2deg(yaw)) for x, y, _, l, w, _, yaw in boxes.tolist()]  # noqa: E741
        return np.asarray(cv2.dnn.NMSBoxesRotated(rectangles, scores.tolist(), 0.0, THRESHOLD)).ravel()

    return call


@pytest.mark.parametrize("contender", contenders("shapely"))
def bench_rotated_iou(contest, boxes, contender):
    boxes, _ = boxes

    def plan(device):
        given = wp.array(boxes, dtype=wp.float32, device=device)
        counts = wp.array([BOXES, BOXES], dtype=wp.int32, device=device)
        made = RotatedIou(rows=BOXES, columns=BOXES, device=device)
        return lambda: made.launch(given, given, counts)

    def function(device):
        given = on_device(boxes, device)
        return lambda: rotated_iou_bev(given, given)

    contest.run(
        contender,
        {"warploom": function, "warploom plan": plan, "shapely": lambda _: shapely_iou(boxes)},
        kernel="rotated_iou_bev", on="1000 × 1000 boxes", size=BOXES, goals={"shapely": 1 / 20},
        agree=lambda ours, theirs: f"largest difference {np.abs(ours - theirs).max():.1e}",
    )  # fmt: skip


@pytest.mark.parametrize("contender", contenders("shapely", "opencv"))
def bench_rotated_nms(contest, boxes, contender):
    boxes, scores = boxes

    def plan(device):
        given = [wp.array(array, dtype=wp.float32, device=device) for array in (boxes, scores)]
        count = wp.array([BOXES], dtype=wp.int32, device=device)
        made = RotatedNms(capacity=BOXES, threshold=THRESHOLD, max_output=BOXES, device=device)
        return lambda: made.launch(*given, count)

    def function(device):
        given, given_scores = on_device(boxes, device), on_device(scores, device)
        return lambda: rotated_nms(given, given_scores, THRESHOLD)

    def agree(ours, theirs):
        alike = len(np.intersect1d(ours, theirs))
        return f"{len(ours)} kept, " + ("the same" if alike == len(ours) == len(theirs) else f"{alike} alike")

    calls = {
        "warploom": function,
        "warploom plan": plan,
        "shapely": lambda _: shapely_nms(boxes, scores),
        "opencv": lambda _: opencv_nms(boxes, scores),
    }
    contest.run(
        contender, calls, kernel="rotated_nms", on="1000 boxes", size=BOXES, agree=agree, goals={"shapely": 1 / 20}
    )


# ---- rays


def open3d_raycast(vertices, faces, rays, *, anew):
    open3d = peer("open3d")

    def grown():
        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(open3d.core.Tensor(vertices), open3d.core.Tensor(faces.astype(np.uint32)))
        return scene

    kept = None if anew else grown()
    return lambda: (kept or grown()).cast_rays(open3d.core.Tensor(rays))["t_hit"].numpy()


def same_hits(ours, theirs):
    hit = np.isfinite(ours.distance)
    both = hit & np.isfinite(theirs)
    off = np.abs(ours.distance[both] - theirs[both])
    alike = (hit == np.isfinite(theirs)).mean()
    return f"{hit.sum()} hits, {100 * alike:.3f} % alike, 99.9 % of them within {np.quantile(off, 0.999):.1e} m"


@pytest.fixture(scope="module")
def scene():
    """Triangles, and the beams of an HDL-64E in the middle of them."""
    vertices, faces = terrain_mesh()
    directions = lidar_model("hdl64").beams[0]
    return vertices, faces, np.zeros_like(directions), directions


@pytest.mark.parametrize("contender", [c for c in contenders("open3d") if c.values[0].who != "warploom plan"])
def bench_raycast(contest, contender, scene):
    vertices, faces, origins, directions = scene

    def function(device):
        given = [on_device(array, device) for array in scene]
        return lambda: raycast(*given)

    rays = np.concatenate([origins, directions], axis=1)
    contest.run(
        contender, {"warploom": function, "open3d": lambda _: open3d_raycast(vertices, faces, rays, anew=True)},
        kernel="raycast", on=f"{len(faces) // 1000}k triangles, tree built anew", size=len(directions),
        agree=same_hits, threads={"open3d": processors()},
    )  # fmt: skip


@pytest.mark.parametrize("contender", [c for c in contenders("open3d") if c.values[0].who != "warploom"])
def bench_lidar_cast(contest, contender, scene):
    """The simulator's sensor, which draws noise and echoes too, on a tree that is there already."""
    vertices, faces, origins, directions = scene

    def plan(device):
        meshes = MeshSet(device)
        number = meshes.add(vertices, faces, np.full(len(faces), face_label(Material.ASPHALT, PointClass.ROAD)))
        lidar = lidar_model("hdl64")
        beams, ring, fraction = lidar.beams
        cast = LidarCast(
            meshes=meshes, beams=beams, ring=ring, time=0.1 * fraction, period=0.1, min_range=lidar.min_range,
            max_range=lidar.max_range, reach=lidar.reach, range_noise=lidar.range_noise, drop_out=lidar.drop_out,
        )  # fmt: skip
        cast.set_materials(material_table())
        cast.place(np.array([number]), np.eye(4)[None])
        cast.aim(np.eye(4))
        return cast.launch

    rays = np.concatenate([origins, directions], axis=1)
    contest.run(
        contender, {"warploom plan": plan, "open3d": lambda _: open3d_raycast(vertices, faces, rays, anew=False)},
        kernel="lidar_cast", on=f"{len(faces) // 1000}k triangles, tree kept", size=len(directions),
        threads={"open3d": processors()},
    )  # fmt: skip
