"""The least that Q says of a state seen in several ways."""

import torch
from torch import Tensor

from graspq.common.action_space import grasping
from graspq.train.networks.network import Features, QNetwork
from graspq.train.state import seeded
from graspq.train.views import VIEWS, least_of_views

SPACE = grasping((0.06, 0.06, 0.06, 0.4))


class Brightness(QNetwork):
    """Q(s, a) = grey level of the pixel (4, 4) + dy."""

    link = "identity"

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        return (image[:, 4, 4, 0].float() + 1000 * step,)

    def head(self, features: Features, action: Tensor) -> Tensor:
        return features[0].unsqueeze(1) + action[..., 1]


def test_one_view_is_the_picture_itself() -> None:
    image = torch.randint(0, 256, (1, 9, 9, 3), dtype=torch.uint8, generator=seeded("tests/views"))
    action = torch.rand(1, 5, 4, generator=seeded("tests/views", 1)) * 2 - 1
    step = torch.tensor([3])
    found = least_of_views(Brightness(), SPACE, image, step, 1)(action)
    torch.testing.assert_close(found, 3000 + float(image[0, 4, 4, 0]) + action[..., 1])


def test_the_smallest_q_of_the_views_counts_with_actions_mirrored_as_the_pictures_are() -> None:
    image = torch.full((1, 9, 9, 3), 100, dtype=torch.uint8)
    action = torch.tensor([[[0.0, 0.5, 0.0, 0.0], [0.0, -0.5, 0.0, 0.0]]])
    step = torch.tensor([0])
    # The picture is its own mirror image: dy counts once as it is and once with the other sign.
    found = least_of_views(Brightness(), SPACE, image, step, 2)(action)
    torch.testing.assert_close(found, torch.tensor([[99.5, 99.5]]))
    for count, (rows, columns, mirrored) in enumerate(VIEWS[2:], start=3):
        dark = image.clone()
        dark[0, 4 + rows, 4 + columns, 0] = 7  # what this view has at (4, 4), the middle, which mirroring leaves
        seen = [least_of_views(Brightness(), SPACE, dark, step, n)(action)[0, 0].item() for n in (count - 1, count)]
        sign = -1 if mirrored else 1
        assert seen == [99.5, 7 + sign * 0.5]
