"""Networks that others publish: what to get, its licence, and how it is fed.

Only what their authors or the file itself state. No checksum is known of an ONNX file of theirs:
the one of the file that was given is recorded with each result.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Preset:
    """One published network; the settings of `OnnxSettings` that are not set are its."""

    get: str  # which file, and where
    licence: str  # and where it is stated
    trained_on: str
    layout: str = "2 inputs of 3 channels"  # `OnnxNetwork.layout`
    mean: tuple[float, ...] = (0.0,)
    std: tuple[float, ...] = (1.0,)
    output: int = -1
    output_scale: float = 1.0
    multiple_px: int = 32


#: Of a network that no preset describes.
OWN: Final = Preset("", "not known", "not known", layout="")

PRESETS: Final = {
    # Ref: Tankovich et al., "HITNet: Hierarchical iterative tile refinement network for real-time
    # stereo matching", CVPR 2021. Grey levels in [0, 1], both images in one input.
    "hitnet": Preset(
        get="hitnet_eth3d_480x640.onnx of github.com/nburrus/stereodemo, release v0.1-hitnet",
        licence="Apache-2.0 (that of the sources in google-research; none is stated for weights)",
        trained_on="ETH3D, by its name; its authors do not state what else",
        layout="1 input of 2 channels",
    ),
    # Ref: Jing et al., "Lite Any Stereo: Efficient zero-shot stereo matching", CVPR 2026. Levels in
    # [0, 255], which it normalises itself.
    "lite-any-stereo": Preset(
        get="LiteAnyStereo.pth of github.com/TomTomTommi/LiteAnyStereo, exported with its "
        "export_onnx.py --version las1",
        licence="MIT (LICENSE of github.com/TomTomTommi/LiteAnyStereo)",
        trained_on="synthetic sets and pairs without truth, named in arXiv:2511.16555; not those "
        "of Middlebury, ETH3D and KITTI, by its authors",
        std=(1 / 255,),
    ),
}
