"""Imported PointPillars against the networks as OpenPCDet and mmdetection3d define them, written anew here in torch.

Random weights, a small grid: the maps agree to 1e-4 (float32, other orders of the same sums), the boxes to 1e-3 m.
"""

import numpy as np
import pytest
import shapely
import torch
import yaml
from torch import nn
from torch.nn import functional

from warploom.errors import ModelError
from warploom.models.anchor_card import AnchorCard, AnchorSpec, PillarSpec, ReadSpec
from warploom.models.anchor_head import AnchorHead
from warploom.models.card import load_card
from warploom.models.classes import CLASSES
from warploom.models.importers.pointpillars import PointPillarsSpec, import_pointpillars

RANGE, PILLAR = (0.0, -10.24, -3.0, 20.48, 10.24, 1.0), (0.32, 0.32, 4.0)
ANCHORS = (
    AnchorSpec(size=(3.9, 1.6, 1.56), bottom=-1.78),
    AnchorSpec(size=(0.8, 0.6, 1.73), bottom=-0.6),
    AnchorSpec(size=(1.76, 0.6, 1.73), bottom=-0.6),
)
CLASS_COUNT, ANCHOR_COUNT, WIDTH = 3, 6, 16
BLOCKS, UPS = ((16, 2), (24, 3), (32, 3)), ((16, 1), (16, 2), (16, 4))


def spec(**read):
    return PointPillarsSpec(
        pillars=PillarSpec(point_range=RANGE, pillar=PILLAR, max_points=8, max_pillars=3000),
        anchors=ANCHORS,
        read=ReadSpec(**{"score_threshold": 0.3, "max_candidates": 8192, **read}),
    )


# ---- state dicts with the names of the two frameworks


def random_norm(prefix, width, rng):
    return {
        f"{prefix}.weight": torch.from_numpy(rng.uniform(0.5, 1.5, width).astype(np.float32)),
        f"{prefix}.bias": torch.from_numpy(rng.normal(0, 0.3, width).astype(np.float32)),
        f"{prefix}.running_mean": torch.from_numpy(rng.normal(0, 0.3, width).astype(np.float32)),
        f"{prefix}.running_var": torch.from_numpy(rng.uniform(0.5, 1.5, width).astype(np.float32)),
        f"{prefix}.num_batches_tracked": torch.tensor(7),
    }


def random_weights(shape, rng, scale=1.0):
    fan = int(np.prod(shape[1:]))
    return torch.from_numpy((rng.normal(0, scale / np.sqrt(fan), shape)).astype(np.float32))


def state_dict(style, features=10, seed=0):
    rng = np.random.default_rng(seed)
    names = {
        "openpcdet": ("vfe", "backbone_2d.blocks", "backbone_2d.deblocks", "dense_head", "conv_box", 1),
        "mmdet3d": ("voxel_encoder", "backbone.blocks", "neck.deblocks", "bbox_head", "conv_reg", 0),
    }[style]
    encoder, blocks, ups, head, boxes, first = names
    state = {f"{encoder}.pfn_layers.0.linear.weight": random_weights((WIDTH, features), rng)}
    state |= random_norm(f"{encoder}.pfn_layers.0.norm", WIDTH, rng)
    before = WIDTH
    for k, (width, layers) in enumerate(BLOCKS):
        for layer in range(layers):
            state[f"{blocks}.{k}.{first + 3 * layer}.weight"] = random_weights((width, before, 3, 3), rng, 1.4)
            state |= random_norm(f"{blocks}.{k}.{first + 3 * layer + 1}", width, rng)
            before = width
        state[f"{ups}.{k}.0.weight"] = random_weights((width, UPS[k][0], UPS[k][1], UPS[k][1]), rng)
        state |= random_norm(f"{ups}.{k}.1", UPS[k][0], rng)
    for name, channels in (("conv_cls", ANCHOR_COUNT * CLASS_COUNT), (boxes, ANCHOR_COUNT * 7),
                           ("conv_dir_cls", ANCHOR_COUNT * 2)):  # fmt: skip
        state[f"{head}.{name}.weight"] = random_weights((channels, 48, 1, 1), rng, 0.6)
        state[f"{head}.{name}.bias"] = torch.from_numpy(rng.normal(-1 if name == "conv_cls" else 0, 0.1, channels)
                                                        .astype(np.float32))  # fmt: skip
    if style == "openpcdet":
        state["global_step"] = torch.tensor([5])
    return state


# ---- the frameworks' forward passes


def pillars_of(points):
    """First come, first served, as loops."""
    index, pillars, cells = {}, [], []
    for point in points:
        inside = all(RANGE[k] <= point[k] < RANGE[k + 3] for k in range(3))
        if not inside:
            continue
        cell = tuple(
            int(np.floor((np.float32(point[k]) - np.float32(RANGE[k])) / np.float32(PILLAR[k]))) for k in (0, 1)
        )
        if cell not in index:
            index[cell] = len(pillars)
            pillars.append([])
            cells.append(cell)
        if len(pillars[index[cell]]) < 8:
            pillars[index[cell]].append(point)
    padded = np.zeros((len(pillars), 8, 4), np.float32)
    for row, some in enumerate(pillars):
        padded[row, : len(some)] = some
    return torch.from_numpy(padded), torch.tensor([len(some) for some in pillars]), np.array(cells)


def norm(x, state, prefix):
    return functional.batch_norm(
        x, state[f"{prefix}.running_mean"], state[f"{prefix}.running_var"], state[f"{prefix}.weight"],
        state[f"{prefix}.bias"], False, 0.0, 1e-3,
    )  # fmt: skip


def framework_maps(state, style, points, *, features=10, legacy=False):
    """PillarVFE / PillarFeatureNet, PointPillarScatter, BaseBEVBackbone / SECOND + SECONDFPN, the anchor head."""
    voxels, counts, cells = pillars_of(points)
    encoder = "vfe" if style == "openpcdet" else "voxel_encoder"
    mean = voxels[:, :, :3].sum(dim=1, keepdim=True) / counts.float().view(-1, 1, 1)
    f_cluster = voxels[:, :, :3] - mean
    f_center = torch.zeros_like(voxels[:, :, :3])
    x_offset, y_offset, z_offset = PILLAR[0] / 2 + RANGE[0], PILLAR[1] / 2 + RANGE[1], PILLAR[2] / 2 + RANGE[2]
    column, row = (torch.from_numpy(cells[:, k]).float().unsqueeze(1) for k in (0, 1))
    f_center[:, :, 0] = voxels[:, :, 0] - (column * PILLAR[0] + x_offset)
    f_center[:, :, 1] = voxels[:, :, 1] - (row * PILLAR[1] + y_offset)
    f_center[:, :, 2] = voxels[:, :, 2] - z_offset
    own = voxels.clone()
    if features == 9:
        f_center = f_center[:, :, :2]
    if legacy:
        own[:, :, : f_center.shape[2]] = f_center
    decorated = torch.cat([own, f_cluster, f_center], dim=-1)
    decorated *= (torch.arange(8)[None] < counts[:, None]).unsqueeze(-1).float()
    x = decorated @ state[f"{encoder}.pfn_layers.0.linear.weight"].t()
    x = norm(x.permute(0, 2, 1), state, f"{encoder}.pfn_layers.0.norm").permute(0, 2, 1)
    x = torch.relu(x).max(dim=1)[0]
    canvas = torch.zeros(WIDTH, 64 * 64)
    canvas[:, cells[:, 1] * 64 + cells[:, 0]] = x.t()
    x = canvas.view(1, WIDTH, 64, 64)
    blocks, ups, first = (
        ("backbone_2d.blocks", "backbone_2d.deblocks", 1) if style == "openpcdet" else
        ("backbone.blocks", "neck.deblocks", 0)
    )  # fmt: skip
    sides = []
    for k, (_, layers) in enumerate(BLOCKS):
        for layer in range(layers):
            stride, place = (2 if layer == 0 else 1), first + 3 * layer
            x = functional.conv2d(functional.pad(x, (1, 1, 1, 1)), state[f"{blocks}.{k}.{place}.weight"], stride=stride)
            x = torch.relu(norm(x, state, f"{blocks}.{k}.{place + 1}"))
        side = functional.conv_transpose2d(x, state[f"{ups}.{k}.0.weight"], stride=UPS[k][1])
        sides.append(torch.relu(norm(side, state, f"{ups}.{k}.1")))
    x = torch.cat(sides, dim=1)
    head, boxes = ("dense_head", "conv_box") if style == "openpcdet" else ("bbox_head", "conv_reg")
    return tuple(
        functional.conv2d(x, state[f"{head}.{name}.weight"], state[f"{head}.{name}.bias"])
        for name in ("conv_cls", boxes, "conv_dir_cls")
    )


def framework_boxes(maps, threshold):
    """AnchorHeadTemplate.generate_predicted_boxes: all boxes above a score, with score and label."""
    scores, residuals, directions = (m[0].permute(1, 2, 0).numpy().astype(np.float64) for m in maps)
    rows, columns = scores.shape[:2]
    xs, ys = np.linspace(RANGE[0], RANGE[3], columns), np.linspace(RANGE[1], RANGE[4], rows)
    found = []
    for r in range(rows):
        for c in range(columns):
            for a in range(ANCHOR_COUNT):
                sure = 1 / (1 + np.exp(-scores[r, c].reshape(ANCHOR_COUNT, CLASS_COUNT)[a]))
                if sure.max() < threshold:
                    continue
                anchor = ANCHORS[a // 2]
                dxa, dya, dza = anchor.size
                xt, yt, zt, dxt, dyt, dzt, rt = residuals[r, c].reshape(ANCHOR_COUNT, 7)[a]
                diagonal = np.hypot(dxa, dya)
                za = anchor.bottom + dza / 2
                yaw = rt + (a % 2) * 1.5707963
                label = np.argmax(directions[r, c].reshape(ANCHOR_COUNT, 2)[a])
                yaw = (yaw - 0.78539) - np.floor((yaw - 0.78539) / np.pi) * np.pi + 0.78539 + np.pi * label
                box = [xt * diagonal + xs[c], yt * diagonal + ys[r], zt * dza + za, np.exp(dxt) * dxa,
                       np.exp(dyt) * dya, np.exp(dzt) * dza, yaw]  # fmt: skip
                found.append((box, sure.max(), int(sure.argmax())))
    return found


def suppress(found, iou):
    def polygon(box):
        c, s = np.cos(box[6]), np.sin(box[6])
        flat = shapely.box(-box[3] / 2, -box[4] / 2, box[3] / 2, box[4] / 2)
        return shapely.affinity.affine_transform(flat, [c, -s, s, c, box[0], box[1]])

    kept = []
    for box, score, label in sorted(found, key=lambda each: -each[1]):
        own = polygon(box)
        if all(own.intersection(p).area / own.union(p).area <= iou for *_, p in kept):
            kept.append((box, score, label, own))
    return kept


@pytest.fixture(scope="module")
def points():
    rng = np.random.default_rng(5)
    places = np.column_stack(
        [rng.uniform(-1, 22, 4000), rng.uniform(-11, 11, 4000), rng.normal(-1, 0.6, 4000), rng.random(4000)]
    )
    places[:2000, :2] = np.round(places[:2000, :2])  # crowded pillars among sparse ones
    return places.astype(np.float32)


def saved(tmp_path, style, wrap=None, **more):
    path = tmp_path / f"{style}.pth"
    state = state_dict(style, **more)
    torch.save({wrap: state, "epoch": 80} if wrap else state, path)
    return path, state


@pytest.mark.parametrize(
    ("style", "wrap", "features", "legacy"),
    [("openpcdet", "model_state", 10, False), ("mmdet3d", "state_dict", 10, False), ("mmdet3d", None, 10, True),
     ("mmdet3d", None, 9, True)],
)  # fmt: skip
def test_maps_are_those_of_the_framework(style, wrap, features, legacy, points, tmp_path):
    path, state = saved(tmp_path, style, wrap, features=features)
    chosen = spec()
    chosen = PointPillarsSpec(
        pillars=chosen.pillars, anchors=chosen.anchors, read=chosen.read, absolute_places=not legacy
    )
    head = AnchorHead(import_pointpillars(path, tmp_path / "head", spec=chosen))
    head.detect_points(points, 1.73)
    expected = framework_maps(state, style, points, features=features, legacy=legacy)
    for name, theirs in zip(("scores", "residuals", "directions"), expected, strict=True):
        np.testing.assert_allclose(head._maps[name].numpy(), theirs.numpy(), atol=1e-4, err_msg=name)


def test_boxes_are_those_of_openpcdet(points, tmp_path):
    path, state = saved(tmp_path, "openpcdet")
    head = AnchorHead(import_pointpillars(path, tmp_path, spec=spec(score_threshold=0.5, nms_iou=0.1)))
    found = head.detect_points(points, 1.73)
    expected = suppress(framework_boxes(framework_maps(state, "openpcdet", points), 0.5), 0.1)
    assert len(found) == len(expected) > 10
    for k, (box, score, label, _) in enumerate(expected):
        assert found.scores[k] == pytest.approx(score, abs=1e-4)
        assert CLASSES[found.classes[k]] == ("vehicle", "pedestrian", "cyclist")[label]
        np.testing.assert_allclose(found.boxes[k, :6], box[:6], atol=1e-3)
        turn = found.boxes[k, 6] - box[6]
        assert abs((turn + np.pi) % (2 * np.pi) - np.pi) < 1e-3


def test_classes_may_be_suppressed_each_by_itself(points, tmp_path):
    """As mmdetection3d's box3d_multiclass_nms: each class is thresholded and suppressed as if it were alone."""
    path, state = saved(tmp_path, "mmdet3d")
    chosen = spec(nms_iou=0.1, score_threshold=0.42, each_class=True)
    found = AnchorHead(import_pointpillars(path, tmp_path, spec=chosen)).detect_points(points, 1.73)
    scores, residuals, directions = framework_maps(state, "mmdet3d", points)
    for label, name in enumerate(("vehicle", "pedestrian", "cyclist")):
        alone = torch.full_like(scores, -20.0)
        alone[:, label::3] = scores[:, label::3]
        expected = suppress(framework_boxes((alone, residuals, directions), 0.42), 0.1)
        own = found.classes == CLASSES.index(name)
        assert own.sum() == len(expected) > 0
        np.testing.assert_allclose(found.boxes[own, :6], [each[0][:6] for each in expected], atol=1e-3)


def test_another_height_of_the_sensor_gives_the_same_boxes_lower(points, tmp_path):
    """The cloud 0.5 m lower is that of a sensor 0.5 m higher; 2e-3 m is for heights rounded otherwise."""
    path, _ = saved(tmp_path, "openpcdet")
    head = AnchorHead(import_pointpillars(path, tmp_path, spec=spec(score_threshold=0.45)))
    near = points[(points[:, 2] > -2.4) & (points[:, 2] < 0.9)]  # within the range in both
    found = head.detect_points(near, 1.73)
    higher = head.detect_points(near - np.array([0, 0, 0.5, 0], np.float32), 2.23)
    assert len(found) == len(higher) > 3
    np.testing.assert_allclose(higher.boxes[:, 2], found.boxes[:, 2] - 0.5, atol=2e-3)
    np.testing.assert_allclose(higher.scores, found.scores, atol=1e-3)


def test_pillars_beyond_those_there_are_do_not_count(points, tmp_path):
    """On a GPU all rows are bound, old ones among them: bound so here, the maps are the same."""
    path, _ = saved(tmp_path, "openpcdet")
    head = AnchorHead(import_pointpillars(path, tmp_path, spec=spec()))
    head.detect_points(points, 1.73)
    few = points[:300]
    head.detect_points(few, 1.73)
    expected = head._maps["scores"].numpy().copy()
    head._bind_pillars(3000)
    head._network.run()
    np.testing.assert_allclose(head._maps["scores"].numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("cloud", [np.zeros((0, 4)), np.full((5, 4), np.nan), np.full((5, 4), 1e9), np.zeros((3, 3))])
def test_little_or_no_cloud_is_no_error(cloud, tmp_path):
    path, _ = saved(tmp_path, "openpcdet")
    head = AnchorHead(import_pointpillars(path, tmp_path, spec=spec(score_threshold=0.99)))
    head.warm_up()
    assert np.isfinite(head.detect_points(cloud.astype(np.float32), 1.73).boxes).all()


def test_limits_of_the_card_are_named_and_heights_checked(points, tmp_path, caplog):
    path, _ = saved(tmp_path, "openpcdet")
    head = AnchorHead(import_pointpillars(path, tmp_path, spec=spec(max_objects=2, nms_iou=1.0)))
    head.detect_points(points, 1.73)
    there = head.overflow + 2
    assert f"beyond the card's limits: dropped {there - 2} of {there}, for read.max_objects is 2" in caplog.text
    with pytest.raises(ValueError, match="sensor_height must be a finite number of metres, not nan"):
        head.detect_points(points, np.nan)


def test_the_card_says_what_the_head_needs(tmp_path):
    path, _ = saved(tmp_path, "openpcdet")
    card, _ = load_card(import_pointpillars(path, tmp_path, spec=spec()), AnchorCard)
    assert card.classes == ("vehicle", "pedestrian", "cyclist")
    assert card.shape == (32, 32)
    assert card.training["framework"] == "OpenPCDet"


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        (("pillars", "point_range"), [0, -4, float("nan"), 8, 4, 1], "point_range.2: Input should be a finite number"),
        (("pillars", "pillar"), [0.16, 0.0, 4], "pillars.pillar must be > 0"),
        (("pillars", "max_pillars"), 10**9, "pillars.max_pillars: Input should be less than or equal to"),
        (("anchors", 0, "size"), [0, 1, 1], "anchors must each have a size above 0"),
        (("anchors", 1, "yaws"), [], "anchors must each have .* one yaw or more"),
        (
            ("classes",),
            ["vehicle", "cyclist", "pedestrian"],
            "its classes are vehicle,pedestrian,cyclist, but the card",
        ),
        (("read", "stride"), 3, "read.stride 3 does not divide the grid"),
        (("opset",), 16, "its opset is 17, but the card"),
    ],
)
def test_a_card_that_does_not_fit_is_refused(where, value, message, tmp_path):
    path, _ = saved(tmp_path, "openpcdet")
    card = import_pointpillars(path, tmp_path, spec=spec())
    content = part = yaml.safe_load(card.read_text())
    for key in where[:-1]:
        part = part[key]
    part[where[-1]] = value
    card.write_text(yaml.safe_dump(content))
    with pytest.raises(ModelError, match=message):
        AnchorHead(card)


class Evil:
    def __reduce__(self):
        return print, ("this must not run",)


def test_hostile_and_damaged_checkpoints_are_refused(tmp_path, capsys):
    path, _ = saved(tmp_path, "openpcdet")
    whole = path.read_bytes()
    bad = tmp_path / "bad.pth"
    for cut in (0, 10, len(whole) // 2, len(whole) - 5):
        bad.write_bytes(whole[:cut])
        with pytest.raises(ModelError, match=r"bad.pth: it is no checkpoint of plain tensors"):
            import_pointpillars(bad, tmp_path)
    torch.save({"state_dict": Evil()}, bad)
    with pytest.raises(ModelError, match="it is no checkpoint of plain tensors"):
        import_pointpillars(bad, tmp_path)
    assert "must not run" not in capsys.readouterr().out
    torch.save([1, 2], bad)
    with pytest.raises(ModelError, match="there is no state dict in it"):
        import_pointpillars(bad, tmp_path)
    with pytest.raises(ModelError, match="no such checkpoint"):
        import_pointpillars(tmp_path / "none.pth", tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.pop("dense_head.conv_cls.weight"), "not PointPillars with anchors"),
        (lambda s: s.pop("dense_head.conv_box.weight"), "lacks residuals.weight"),
        (lambda s: s.update({"roi_head.fc": torch.zeros(2)}), "has besides roi_head.fc"),
        (lambda s: s.update({"dense_head.conv_cls.bias": torch.zeros(6)}), "scores.bias has shape"),
        (lambda s: s.update({"dense_head.conv_cls.bias": torch.full((18,), np.nan)}), "not finite"),
        (lambda s: s.update({"vfe.pfn_layers.0.linear.weight": torch.zeros(16, 5)}), "its points have 5 features"),
        (lambda s: s.pop("backbone_2d.deblocks.1.0.weight"), "lacks ups.1.0.weight"),
        (lambda s: s.update({"backbone_2d.deblocks.1.0.weight": torch.zeros(3, 3)}), "ups.1.0.weight has shape"),
    ],
)
def test_other_networks_are_refused_by_name(change, message, tmp_path):
    state = state_dict("openpcdet")
    change(state)
    path = tmp_path / "other.pth"
    torch.save(state, path)
    with pytest.raises(ModelError, match=message):
        import_pointpillars(path, tmp_path, spec=spec())


@pytest.mark.parametrize("count", [None, torch.tensor([3]), torch.full((), 7)])
def test_how_many_batches_were_seen_is_of_no_use(count, points, tmp_path):
    """Frameworks leave it out, or keep it in a shape of their own."""
    state = state_dict("openpcdet")
    counts = [name for name in state if name.endswith("num_batches_tracked")]
    assert counts
    for name in counts:
        state.pop(name)
        if count is not None:
            state[name] = count
    path = tmp_path / "counted.pth"
    torch.save(state, path)
    load_card(import_pointpillars(path, tmp_path, spec=spec()), AnchorCard)


def test_other_networks_of_torch_are_refused(tmp_path):
    path = tmp_path / "linear.pth"
    torch.save(nn.Linear(2, 2).state_dict(), path)
    with pytest.raises(ModelError, match="not PointPillars with anchors of OpenPCDet or mmdetection3d"):
        import_pointpillars(path, tmp_path)


def test_a_configuration_file_says_what_differs_from_kitti(tmp_path):
    path = tmp_path / "spec.yaml"
    path.write_text("read: {score_threshold: 0.2}\nabsolute_places: false\n")
    read = PointPillarsSpec.read_file(path)
    assert read.read.score_threshold == 0.2
    assert not read.absolute_places
    assert read.anchors == PointPillarsSpec().anchors
    for text, message in (("reed: 1", "expected some of"), ("read: {stride: 0}", "stride"), ("[", "cannot read"),
                          ("anchors: 3", r"spec.yaml: anchors"), ("strides: [a]", r"strides.0")):  # fmt: skip
        path.write_text(text)
        with pytest.raises(ModelError, match=message):
            PointPillarsSpec.read_file(path)
