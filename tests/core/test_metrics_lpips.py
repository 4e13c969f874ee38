"""LPIPS: random weights of the official shapes, both naming schemes, a slow twin of torch modules in float64."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from rsavatar.errors import DataError
from rsavatar.metrics import image, lpips
from rsavatar.metrics.image import Image, Mask

LAYERS = (64, 64, "pool", 128, 128, "pool", 256, 256, 256, "pool", 512, 512, 512, "pool", 512, 512, 512)
State = dict[str, torch.Tensor]
Pair = tuple[Image, Image]
TAPS = (3, 8, 15, 22, 29)  # indices of the ReLUs 1_2, 2_2, 3_3, 4_3, 5_3


def vgg() -> torch.nn.Sequential:
    layers: list[torch.nn.Module] = []
    channels = 3
    for layer in LAYERS:
        if isinstance(layer, int):
            layers += [torch.nn.Conv2d(channels, layer, 3, padding=1), torch.nn.ReLU()]
            channels = layer
        else:
            layers.append(torch.nn.MaxPool2d(2))
    return torch.nn.Sequential(*layers)


@pytest.fixture(scope="module")
def state() -> State:
    with torch.random.fork_rng():
        torch.manual_seed(3)
        tensors = {f"features.{k}": v.detach() for k, v in vgg().state_dict().items()}
        heads = {f"lin{i}.model.1.weight": torch.rand(1, c, 1, 1) for i, c in enumerate((64, 128, 256, 512, 512))}
    return {**tensors, **heads}


@pytest.fixture(scope="module")
def weights(state: State, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lpips") / "weights.pth"
    torch.save(state, path)
    return path


@pytest.fixture
def pair() -> Pair:
    rng = np.random.default_rng(1)
    return rng.random((40, 36, 3), dtype=np.float32), rng.random((40, 36, 3), dtype=np.float32)


@pytest.fixture
def mask() -> Mask:
    inside = np.zeros((40, 36), bool)
    inside[4:30, 6:31] = True
    inside[10, 12] = False
    return inside


def twin(state: State, a: Image, b: Image) -> float:
    network = vgg().double()
    network.load_state_dict({k.removeprefix("features."): v for k, v in state.items() if k.startswith("features")})
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x = torch.stack([torch.from_numpy(i).double() * 2 - 1 for i in (a, b)])
    x, total = ((x - shift) / scale).permute(0, 3, 1, 2), 0.0
    for i, layer in enumerate(network):
        x = layer(x)
        if i in TAPS:
            unit = x / x.norm(dim=1, keepdim=True)
            head = state[f"lin{TAPS.index(i)}.model.1.weight"].double()
            total += ((unit[0] - unit[1]) ** 2 * head[0]).sum(0).mean().item()
    return total


def test_absent_weights_are_said_plainly(monkeypatch: pytest.MonkeyPatch, pair: Pair, mask: Mask) -> None:
    monkeypatch.delenv("RSAVATAR_LPIPS_WEIGHTS", raising=False)
    assert image.lpips(*pair, mask) is None
    assert lpips.lpips_state() == "weights absent (set RSAVATAR_LPIPS_WEIGHTS)"


def test_equals_the_twin_on_the_box_with_black_outside(
    monkeypatch: pytest.MonkeyPatch, weights: Path, state: State, pair: Pair, mask: Mask
) -> None:
    monkeypatch.setenv("RSAVATAR_LPIPS_WEIGHTS", str(weights))
    a, b = (np.where(mask[..., None], i, np.float32(0))[4:30, 6:31] for i in pair)
    with torch.inference_mode():
        wanted = twin(state, a, b)
    assert image.lpips(*pair, mask) == pytest.approx(wanted, rel=1e-4)  # float32 through 13 convolutions
    assert image.lpips(pair[0], pair[0].copy(), mask) == 0.0


def test_state_names_the_file_by_content(monkeypatch: pytest.MonkeyPatch, weights: Path) -> None:
    monkeypatch.setenv("RSAVATAR_LPIPS_WEIGHTS", str(weights))
    assert lpips.lpips_state() == "sha256 " + hashlib.sha256(weights.read_bytes()).hexdigest()[:12]


def test_a_body_smaller_than_the_network_is_laid_on_black(weights: Path) -> None:
    a, b = np.zeros((3, 5, 3), np.float32), np.ones((3, 5, 3), np.float32)
    wide = np.zeros((16, 16, 3), np.float32)
    wide[:3, :5] = 1
    assert lpips.distance(weights, a, b) == lpips.distance(weights, np.zeros_like(wide), wide) > 0


def test_both_namings_and_both_formats_give_the_same_number(
    tmp_path: Path, weights: Path, state: State, pair: Pair
) -> None:
    slices = {i: f"net.slice{s + 1}.{i}" for s, stage in enumerate(lpips.STAGES) for i, _, _ in stage}
    renamed = {}
    for key, value in state.items():
        _, index, kind = key.split(".", 2)
        renamed[f"{slices[int(index)]}.{kind}" if key.startswith("features") else key] = value.contiguous()
    save_file(renamed, tmp_path / "weights.safetensors")
    assert lpips.distance(tmp_path / "weights.safetensors", *pair) == lpips.distance(weights, *pair)


class Executes:
    def __reduce__(self) -> tuple[object, ...]:
        return (print, ("a pickle ran code",))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"features.0.weight": torch.zeros(64, 3, 3, 3)}, r"features.0.bias .*got nothing"),
        ({"features.0.weight": torch.zeros(1, 3, 3, 3)}, r"shape \[64, 3, 3, 3\]"),
        ([1, 2], "a state dict, got list"),
        ({"features.0.weight": Executes()}, "state dict"),
    ],
)
def test_a_wrong_file_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: object, words: str
) -> None:
    torch.save(content, tmp_path / "bad.pth")
    with pytest.raises(DataError, match=words):
        lpips.load_weights(tmp_path / "bad.pth")
    assert "ran code" not in capsys.readouterr().out


@pytest.mark.parametrize("name", ["cut.pth", "cut.safetensors"])
def test_a_damaged_file_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"\x80\x02 not weights")
    with pytest.raises(DataError, match="LPIPS weights"):
        lpips.load_weights(tmp_path / name)


def test_a_named_file_that_is_not_there_is_an_error_not_an_absence(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, pair: Pair, mask: Mask
) -> None:
    monkeypatch.setenv("RSAVATAR_LPIPS_WEIGHTS", str(tmp_path / "none.pth"))
    with pytest.raises(DataError, match="which is not there"):
        image.lpips(*pair, mask)
