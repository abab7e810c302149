import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gripper_force.vision.backbones import Mobile, ResNet18, Vgg, _InvertedResidual, _Residual
from gripper_force.vision.header import STRIDES


def convolved(x: Tensor, pair: nn.Module, stride: int = 1) -> Tensor:
    """Applies a convolution and batch normalisation in evaluation mode, by their definitions."""
    convolution, norm = pair.children()
    assert isinstance(convolution, nn.Conv2d)
    assert isinstance(norm, nn.BatchNorm2d)
    padding = convolution.weight.shape[-1] // 2
    x = F.conv2d(x, convolution.weight, stride=stride, padding=padding, groups=convolution.groups)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    mean, var, scale, shift = (
        t[:, None, None] for t in (norm.running_mean, norm.running_var, norm.weight, norm.bias)
    )
    return (x - mean) / (var + 1e-5).sqrt() * scale + shift


def drawn(network: nn.Module) -> nn.Module:
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            assert module.running_mean is not None
            assert module.running_var is not None
            nn.init.normal_(module.running_mean, std=0.1)
            nn.init.uniform_(module.running_var, 0.5, 1.5)
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias, std=0.1)
    return network.double().eval().requires_grad_(False)


def parameters(network: nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def test_layers_are_those_of_table_2() -> None:
    vgg = Vgg(width=1.0)
    convolutions = [conv for pair in zip(vgg.first, vgg.second, strict=True) for conv in pair]
    assert [conv.out_channels for conv in convolutions] == [16, 16, 32, 32, 64, 64, 128, 128, 256, 256]
    assert all(conv.kernel_size == (3, 3) for conv in convolutions)
    assert vgg(torch.zeros(2, 1, 32, 48)).shape == (2, 256, 2, 3)


@pytest.mark.parametrize(("make", "full"), [(Vgg, 256), (ResNet18, 512), (Mobile, 256)])
def test_width_scales_the_channels(make: type[Vgg | ResNet18 | Mobile], full: int) -> None:
    assert make(width=1.0).out_channels == full
    half = make(width=0.5)
    assert half.out_channels == full // 2
    side = STRIDES[make.__name__.lower()]  # type: ignore[index]
    maps = half(torch.randn(2, 1, side, 3 * side))
    assert maps.shape == (2, full // 2, 1, 3)
    assert maps.min() >= 0
    assert make(width=1e-3)(torch.zeros(2, 1, side, side)).shape == (2, 1, 1, 1)


def test_equals_pooling_after_relu() -> None:
    torch.manual_seed(0)
    vgg = Vgg(width=0.25).eval()
    x = frames = torch.randn(2, 1, 32, 32)
    for i in range(5):
        x = F.relu(vgg.second[i](F.relu(vgg.first[i](x))))
        if i < 4:
            x = vgg.norm[i](F.max_pool2d(x, 2))
    torch.testing.assert_close(vgg(frames), x, rtol=0, atol=0)


def test_resnet_has_the_18_layers_of_its_paper() -> None:
    torch.manual_seed(0)
    resnet = ResNet18(width=0.125)
    drawn(resnet)
    frames = torch.randn(2, 1, 64, 96, dtype=torch.float64)
    x = F.max_pool2d(F.relu(convolved(frames, resnet.stem, 2)), 3, 2, 1)
    for i, block in enumerate(resnet.blocks):
        assert isinstance(block, _Residual)
        stride = 2 if i in (2, 4, 6) else 1
        shortcut = x if stride == 1 else convolved(x, block.shortcut, 2)
        x = F.relu(convolved(F.relu(convolved(x, block.first, stride)), block.second) + shortcut)
    torch.testing.assert_close(resnet(frames), x, rtol=1e-12, atol=1e-12)
    assert x.shape == (2, 64, 2, 3)


def test_resnet_has_the_known_size() -> None:
    resnet = ResNet18(width=1.0)
    layers = [m for m in resnet.modules() if isinstance(m, nn.Conv2d) and m.kernel_size != (1, 1)]
    assert len(layers) == 17, "the 18th is the head"
    # torchvision's counts 11,689,512: 513,000 in its head, and two more input channels in its first layer.
    assert parameters(resnet) == 11_689_512 - 513_000 - 2 * 7 * 7 * 64


def test_mobile_is_inverted_residuals() -> None:
    torch.manual_seed(0)
    mobile = Mobile(width=0.5)
    drawn(mobile)
    frames = torch.randn(2, 1, 32, 48, dtype=torch.float64)
    x = F.relu6(convolved(frames, mobile.stem, 2))
    for i, block in enumerate(mobile.blocks):
        assert isinstance(block, _InvertedResidual)
        inner = F.relu6(convolved(x, block.widen))
        assert inner.shape[1] == 4 * x.shape[1]
        (filters, _) = block.filter
        assert isinstance(filters, nn.Conv2d)
        assert filters.groups == inner.shape[1], "one filter for each channel"
        narrow = convolved(F.relu6(convolved(inner, block.filter, 1 if i % 2 else 2)), block.narrow)
        x = narrow + x if i % 2 else narrow
    x = F.relu6(convolved(x, mobile.last))
    torch.testing.assert_close(mobile(frames), x, rtol=1e-12, atol=1e-12)
    assert x.shape == (2, 128, 2, 3)


def test_mobile_is_a_seventh_of_the_vgg_like_network() -> None:
    assert 6.5 < parameters(Vgg(width=1.0)) / parameters(Mobile(width=1.0)) < 7.5
