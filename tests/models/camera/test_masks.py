"""TwinLiteNet as a head against its authors' network, written anew here as functions over the weights.

Masks may differ where two logits are all but equal: in at most 0.1 % of the pixels.
"""

import numpy as np
import pytest
import torch
from torch.nn import functional

from warploom.errors import ModelError
from warploom.models.camera.masks import MaskHead
from warploom.models.importers.twinlitenet import TwinLiteNet, import_twinlitenet

cv2 = pytest.importorskip("cv2")


@pytest.fixture(autouse=True)
def one_thread():
    """Threads that spin for each other take a minute for this where the cores are busy."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


class Authors:
    """model/TwinLite.py, with the state dict as it is."""

    def __init__(self, state):
        self.s = {name.removeprefix("module."): value for name, value in state.items()}

    def conv(self, x, name, stride=1, dilation=1):
        weight = self.s[f"{name}.weight"]
        padding = (weight.shape[-1] - 1) // 2 * dilation
        return functional.conv2d(x, weight, self.s.get(f"{name}.bias"), stride, padding, dilation)

    def bn(self, x, name):
        p = [self.s[f"{name}.{each}"] for each in ("running_mean", "running_var", "weight", "bias")]
        return functional.batch_norm(x, *p, False, 0.0, 1e-3)

    def act(self, x, name):
        return functional.prelu(x, self.s[f"{name}.act.weight"])

    def cbr(self, x, name, stride=1):
        return self.act(self.bn(self.conv(x, f"{name}.conv", stride), f"{name}.bn"), name)

    def esp(self, x, name, stride):
        y = self.conv(x, f"{name}.c1.conv", stride)
        d1, d2, d4, d8, d16 = (self.conv(y, f"{name}.d{d}.conv", 1, d) for d in (1, 2, 4, 8, 16))
        return torch.cat([d1, d2, d2 + d4, d2 + d4 + d8, d2 + d4 + d8 + d16], 1)

    def down(self, x, name):
        return self.act(self.bn(self.esp(x, name, 2), f"{name}.bn"), name)

    def residual(self, x, name):
        return self.act(self.bn(x + self.esp(x, name, 1), f"{name}.bn.bn"), f"{name}.bn")

    def up(self, x, name):
        x = functional.conv_transpose2d(x, self.s[f"{name}.deconv.weight"], stride=2)
        return self.act(self.bn(x, f"{name}.bn"), name)

    def __call__(self, image):
        e = "encoder."
        pool = torch.nn.AvgPool2d(3, stride=2, padding=1)
        inp1, inp2 = pool(image), pool(pool(image))
        cat0 = self.cbr(torch.cat([self.cbr(image, e + "level1", 2), inp1], 1), e + "b1")
        out1_0 = self.down(cat0, e + "level2_0")
        out1 = self.residual(self.residual(out1_0, e + "level2.0"), e + "level2.1")
        out2_0 = self.down(self.cbr(torch.cat([out1, out1_0, inp2], 1), e + "b2"), e + "level3_0")
        out2 = out2_0
        for k in range(3):
            out2 = self.residual(out2, f"{e}level3.{k}")
        x = self.cbr(torch.cat([out2_0, out2], 1), e + "b3")
        b, c, h, w = x.shape
        query = self.conv(x, e + "sa.query_conv").view(b, -1, w * h).permute(0, 2, 1)
        attention = torch.softmax(torch.bmm(query, self.conv(x, e + "sa.key_conv").view(b, -1, w * h)), -1)
        out = torch.bmm(self.conv(x, e + "sa.value_conv").view(b, -1, w * h), attention.permute(0, 2, 1))
        places = self.s[e + "sa.gamma"] * out.view(b, c, h, w) + x
        energy = torch.bmm(x.view(b, c, -1), x.view(b, c, -1).permute(0, 2, 1))
        attention = torch.softmax(torch.max(energy, -1, keepdim=True)[0].expand_as(energy) - energy, -1)
        channels = self.s[e + "sc.gamma"] * torch.bmm(attention, x.view(b, c, -1)).view(b, c, h, w) + x
        x = self.cbr(self.cbr(places, e + "conv_sa") + self.cbr(channels, e + "conv_sc"), e + "classifier")
        return tuple(self.up(self.up(self.up(x, f"up_1_{k}"), f"up_2_{k}"), f"classifier_{k}") for k in (1, 2))


@pytest.fixture(scope="module")
def random_checkpoint(tmp_path_factory):
    torch.manual_seed(4)
    network = TwinLiteNet()
    for parameter in network.parameters():
        if parameter.ndim == 1:
            torch.nn.init.uniform_(parameter, 0.2, 0.8)
    for name, value in network.named_buffers():
        if name.endswith(("running_mean", "running_var")):
            torch.nn.init.uniform_(value, 0.1, 1.0)
    path = tmp_path_factory.mktemp("twin") / "twin.pth"
    torch.save({f"module.{name}": value for name, value in network.state_dict().items()}, path)
    return path


@pytest.fixture(scope="module")
def random_card(random_checkpoint):
    return import_twinlitenet(random_checkpoint, random_checkpoint.parent / "head")


def test_logits_are_those_of_the_authors_network(random_checkpoint, random_card):
    """Every part with weights that matter, attention included; relative 1e-3 for other orders of sums."""
    head = MaskHead(random_card)
    image = np.random.default_rng(0).integers(0, 256, (360, 640, 3), np.uint8)
    masks = head.detect(image)
    tensor = torch.from_numpy(image[:, :, ::-1].transpose(2, 0, 1)[None].astype(np.float32) / 255.0)
    with torch.no_grad():
        expected = Authors(torch.load(random_checkpoint, weights_only=True))(tensor)
    for k, theirs in enumerate(expected):
        scale = float(theirs.abs().max())
        np.testing.assert_allclose(head._out[k].numpy(), theirs.numpy(), atol=1e-3 * scale)
        assert (masks.masks[k] == theirs[0].argmax(0).numpy().astype(bool)).mean() > 0.999


@pytest.mark.real
def test_the_road_ahead_is_drivable(shared_data, tmp_path):
    checkpoint = shared_data / "weights" / "twinlitenet" / "twinlitenet_best.pth"
    image = cv2.imread(str(shared_data / "kitti_object" / "image_2" / "000005.png"))
    found = MaskHead(import_twinlitenet(checkpoint, tmp_path)).detect(image)
    assert found.masks.shape == (2, *image.shape[:2])
    small = cv2.resize(image, (640, 360))[:, :, ::-1].transpose(2, 0, 1)[None].astype(np.float32) / 255.0
    with torch.no_grad():
        areas, lanes = Authors(torch.load(checkpoint, map_location="cpu", weights_only=True))(torch.from_numpy(small))
    for name, theirs in (("drivable_area", areas), ("lane", lanes)):
        mask = cv2.resize(theirs[0].argmax(0).numpy().astype(np.uint8), image.shape[1::-1], interpolation=0)
        assert (found[name] == mask.astype(bool)).mean() > 0.999
    low = found["drivable_area"][-60:, 500:740]  # right before the car
    assert low.mean() > 0.8
    assert found["drivable_area"][:100].mean() < 0.01  # the sky is not


def test_other_checkpoints_are_refused(tmp_path):
    path = tmp_path / "other.pth"
    torch.save(torch.nn.Linear(2, 2).state_dict(), path)
    with pytest.raises(ModelError, match="this is not a TwinLiteNet: it lacks"):
        import_twinlitenet(path, tmp_path)
    path.write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(ModelError, match="it is no checkpoint of plain tensors"):
        import_twinlitenet(path, tmp_path)


def test_a_card_of_other_outputs_is_refused(random_card):
    card = random_card.with_name("other.yaml")
    text = random_card.read_text()
    card.write_text(text.replace("- drivable_area\n- lane\n", "- lane\n- drivable_area\n"))
    with pytest.raises(ModelError, match="its classes are drivable_area,lane, but the card says lane,drivable_area"):
        MaskHead(card)
    card.write_text(text.replace("fit: stretch", "fit: letterbox"))
    with pytest.raises(ModelError, match=r"other\.yaml: masks are of whole images: input\.fit must be stretch"):
        MaskHead(card)
