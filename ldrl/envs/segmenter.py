"""Predicted road segmentation: the road as a network sees it in the dash camera's rgb images."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import conv2d, interpolate
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import Transform

from ldrl import keys
from ldrl.envs.camera import see_moving
from ldrl.envs.image_format import PREPROCESSING, ImageFormat

if TYPE_CHECKING:
    from transformers import MobileNetV2ForSemanticSegmentation

__all__ = ["RoadSegmenter"]

SHIPPED = Path(__file__).parent / "weights"
FRAMES_AT_ONCE = {"cpu": 32, "cuda": 1024}
"""Frames segmented together: on a processor so few that a layer's output stays in its cache."""


class RoadSegmenter(Transform):
    """Replaces rgb images by the road that a network sees in them, in the form of the dash camera's ``gs``.

    The network is DeepLabv3+ on MobileNetV2 (Sandler et al. 2018), as in Roh et al. 2019, by ``transformers``. It
    stands behind a :class:`~ldrl.envs.DashCamera` with ``modality="rgb"``, in an env or in a replay buffer. A pixel is
    road where the road's logit, less the largest of all others, is above 0 once scaled up to the image.

    Args:
        name: weights that ship with the package, a folder, or a model on the Hugging Face Hub, which is then
            downloaded. There must be a ``preprocessor_config.json`` with them.
        road: the class that means road, by its number or a name that it has in the weights' ``id2label``, where
            "road, route" is two names.

    Raises:
        ImportError: ``transformers`` is missing.
        ValueError: there are no such weights, or they know no such class.

    Examples:
        >>> from ldrl.envs import DashCamera
        >>> from ldrl.towns import Town
        >>> rgb = DashCamera(Town.load("town1"), modality="rgb").draw(torch.tensor([[200.0, 2.0, 3.14]]))
        >>> RoadSegmenter().segment(rgb).shape
        torch.Size([1, 1, 88, 200])
    """

    def __init__(self, name: str | Path = "road-segmenter", *, road: str | int = "road") -> None:
        super().__init__(in_keys=[keys.IMAGE], out_keys=[keys.IMAGE])
        network, self.format = _load(SHIPPED / name if (SHIPPED / name / PREPROCESSING).is_file() else name)
        self.road = _class_number(network.config.id2label, road)
        self.network = _for_inference(network).requires_grad_(False).eval()

    @torch.no_grad()
    def segment(self, images: Tensor) -> Tensor:
        """Find the road.

        Args:
            images: ``[*B, 3, 88, 200]`` uint8.

        Returns:
            ``[*B, 1, 88, 200]`` uint8: 255 where there is road, 0 elsewhere.
        """
        if images.dtype != torch.uint8 or images.ndim < 3 or images.shape[-3] != 3:
            raise ValueError(
                f"images are {images.dtype} {list(images.shape)}, expected uint8 [*B, 3, 88, 200]; "
                "put a DashCamera(town, modality='rgb') before the RoadSegmenter"
            )
        rows, columns = images.shape[-2:]
        batch, images = images.shape[:-3], images.reshape(-1, 3, rows, columns)
        road = images.new_zeros(len(images), 1, rows, columns)
        at_once = FRAMES_AT_ONCE["cpu" if images.device.type == "cpu" else "cuda"]
        for few, seen in zip(images.split(at_once), road.split(at_once), strict=True):
            logits = self.network(self.format.pixels(few)).logits
            others = torch.cat((logits[:, : self.road], logits[:, self.road + 1 :]), 1).amax(1, keepdim=True)
            margin = logits[:, self.road : self.road + 1] - others
            size = (rows - self.format.first_row, columns)
            seen[:, :, self.format.first_row :] = (interpolate(margin, size, mode="bilinear") > 0).to(torch.uint8) * 255
        return road.view(*batch, *road.shape[1:])

    _apply_transform = segment

    _step = see_moving

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Give the image one channel."""
        *batch, _, rows, columns = observation_spec[keys.IMAGE].shape
        observation_spec[keys.IMAGE] = Bounded(0, 255, (*batch, 1, rows, columns), observation_spec.device, torch.uint8)
        return observation_spec


def _load(name: str | Path) -> tuple[MobileNetV2ForSemanticSegmentation, ImageFormat]:
    """A network and the form of its images."""
    try:
        transformers = import_module("transformers")
    except ImportError as error:
        raise ImportError(f"RoadSegmenter needs transformers ({error}); pip install transformers") from error
    local = Path(name).is_dir()
    try:
        with _no_progress_bar(transformers.utils.logging):
            network, found = transformers.MobileNetV2ForSemanticSegmentation.from_pretrained(
                name, local_files_only=local, output_loading_info=True
            )
            image_format = transformers.utils.cached_file(name, PREPROCESSING, local_files_only=local)
    except (OSError, RuntimeError, SafetensorError) as error:
        shipped = ", ".join(sorted(path.parent.name for path in SHIPPED.glob(f"*/{PREPROCESSING}")))
        raise ValueError(
            f"no segmenter {str(name)!r} ({error}); give a folder with model.safetensors, config.json and "
            f"{PREPROCESSING}, a model on the Hub, or one of the shipped ones: {shipped}"
        ) from None
    if found["missing_keys"]:
        raise ValueError(
            f"the weights of {str(name)!r} are no MobileNetV2ForSemanticSegmentation's: {min(found['missing_keys'])} "
            "is missing; take weights that were trained for segmentation"
        )
    return network, ImageFormat.read(image_format)


@contextmanager
def _no_progress_bar(settings: ModuleType) -> Iterator[None]:
    """Keep ``transformers`` from showing one for a file of a megabyte."""
    shown = settings.is_progress_bar_enabled()
    settings.disable_progress_bar()
    try:
        yield
    finally:
        if shown:
            settings.enable_progress_bar()


def _class_number(names: dict[int, str], road: str | int) -> int:
    """The number of the class that means road."""
    for number, name in names.items():
        if road in (number, name, *name.split(", ")):
            return number
    listed = ", ".join(f"{number} {name!r}" for number, name in names.items())
    raise ValueError(f"the weights know no class {road!r}; give RoadSegmenter road=, the one that means road: {listed}")


def _for_inference(network: MobileNetV2ForSemanticSegmentation) -> nn.Module:
    """Fold normalisation into the convolutions and leave out what does not reach the logits."""
    network.mobilenet_v2.conv_1x1 = nn.Identity()  # classification's: the head reads the layer before it
    for layer in network.modules():
        norm: Any = getattr(layer, "normalization", None)
        if norm is not None:
            layer.convolution = nn.utils.fuse_conv_bn_eval(layer.convolution.eval(), norm.eval())
            layer.normalization = None
        if isinstance(layer, (nn.ReLU, nn.ReLU6)):
            layer.inplace = True
    network.segmentation_head = _Head(network.segmentation_head)
    return network.to(memory_format=torch.channels_last)


class _Head(nn.Module):
    """What DeepLabv3+'s head computes, in a third of the time, and without dropout, whatever mode an env sets.

    The projection reads the image's mean beside each pixel's features: here it is projected once, not in each pixel.

    Args:
        head: of a ``MobileNetV2ForSemanticSegmentation``, with normalisation folded in.
    """

    def __init__(self, head: Any) -> None:
        super().__init__()
        self.pool, self.aspp, self.classifier = head.conv_pool, head.conv_aspp, head.classifier
        both = head.conv_projection.convolution
        of_pool, of_aspp = both.weight.split(
            [self.pool.convolution.out_channels, self.aspp.convolution.out_channels], 1
        )
        self.of_pool, self.of_aspp, self.bias = map(nn.Parameter, (of_pool.clone(), of_aspp.clone(), both.bias))

    def forward(self, features: Tensor) -> Tensor:
        """Logits ``[N, classes, h, w]`` from features ``[N, C, h, w]``."""
        mean = conv2d(self.pool(features.mean((2, 3), keepdim=True)), self.of_pool, self.bias)
        return self.classifier(conv2d(self.aspp(features), self.of_aspp).add_(mean).relu_())
