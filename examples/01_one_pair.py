"""One stereo pair: disparity, its accuracy, and a coloured point cloud.

    python examples/01_one_pair.py [FOLDER]

The pair is rendered, so the ground truth is known. For your own images, read them with
`recon.read_image` and their calibration with `recon.read_calibration`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import recon


def main(folder: Path) -> None:
    """Reconstruct the first pair of a synthetic street."""
    source = recon.SyntheticSource()
    pair = next(iter(source))

    frame = recon.reconstruct(pair.left, pair.right, source.calibration)

    disparity = frame.disparity
    measured, inferred = disparity.measured.mean(), disparity.inferred.mean()
    print(
        f"{measured:.0%} of the pixels were measured, {inferred:.0%} inferred from planes around:"
    )
    for reason in recon.Reason:
        print(f"  {(disparity.reason == reason).mean():6.1%}  {reason.name.lower()}")

    errors = recon.evaluate_disparity(disparity, source.disparity_truth(0))
    print(f"mean error {errors.avgerr_px:.2f} px, {errors.bad[1.0]:.1f} % off by more than 1 px")

    recon.write_ply(folder / "cloud.ply", frame.cloud)
    print(f"{len(frame.cloud)} points in {folder / 'cloud.ply'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "outputs/examples/one_pair"))
