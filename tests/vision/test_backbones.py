import torch
import torch.nn.functional as F

from gripper_force.vision.backbones import Vgg


def test_layers_are_those_of_table_2() -> None:
    vgg = Vgg(width=1.0)
    convolutions = [conv for pair in zip(vgg.first, vgg.second, strict=True) for conv in pair]
    assert [conv.out_channels for conv in convolutions] == [16, 16, 32, 32, 64, 64, 128, 128, 256, 256]
    assert all(conv.kernel_size == (3, 3) for conv in convolutions)
    assert vgg(torch.zeros(2, 1, 32, 48)).shape == (2, 256, 2, 3)


def test_width_scales_the_channels() -> None:
    assert Vgg(width=0.5).out_channels == 128
    assert Vgg(width=0.5)(torch.zeros(2, 1, 16, 16)).shape == (2, 128, 1, 1)


def test_equals_the_literal_order_of_layers() -> None:
    torch.manual_seed(0)
    vgg = Vgg(width=0.25).eval()
    x = frames = torch.randn(2, 1, 32, 32)
    for i in range(5):
        x = F.relu(vgg.second[i](F.relu(vgg.first[i](x))))
        if i < 4:
            x = vgg.norm[i](F.max_pool2d(x, 2))
    torch.testing.assert_close(vgg(frames), x, rtol=0, atol=0)
