"""Pictures of where splat diffusion and its baselines err."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image
from skimage.metrics import structural_similarity as ssim

from splatjax.io import linear_to_srgb


def errors(
    pictures: dict[str, np.ndarray],
    truth: np.ndarray,
    covered: np.ndarray,
    root: np.ndarray,
    path: Path,
) -> dict[str, dict[str, float | None]]:
    """Draw the truth, and by how much each method's exitance is off; give SSIM and FLIP of what
    leaves, as a display shows it.
    """
    exposure = 0.8 / np.quantile((truth * root)[covered], 0.98)

    def shown(exitance):
        return linear_to_srgb(np.where(covered[..., None], exposure * exitance * root, 0.0)).astype(
            np.float32
        )

    found, reference = {}, shown(truth)
    figure, axes = plt.subplots(
        2, (len(pictures) + 2) // 2, figsize=(2.3 * ((len(pictures) + 2) // 2), 4.9), squeeze=False
    )
    for axis in axes.flat:
        axis.set_axis_off()
    axes.flat[0].imshow(reference, interpolation="nearest")
    axes.flat[0].set_title("integrated over the surface", fontsize=7)
    scale = np.sqrt(np.mean(truth[covered] ** 2, axis=0))
    for axis, (name, picture) in zip(list(axes.flat)[1:], pictures.items(), strict=False):
        ours = shown(picture)
        found[name] = {
            "ssim": ssim(ours, reference, channel_axis=2, data_range=1.0, gaussian_weights=True),
            "flip": flip(reference, ours),
        }
        off = np.where(covered[..., None], 0.5 + 5 * (picture - truth) / scale, 0.5)
        axis.imshow(np.clip(off, 0, 1), interpolation="nearest")
        axis.set_title(name, fontsize=7)
    figure.tight_layout(pad=0.3, h_pad=1.2)
    figure.savefig(path.with_suffix(".raw.png"), dpi=100)
    plt.close(figure)
    with Image.open(path.with_suffix(".raw.png")) as picture:
        save(np.asarray(picture.convert("RGB"), np.float64) / 255, path)
    path.with_suffix(".raw.png").unlink()
    return found


def flip(reference: np.ndarray, picture: np.ndarray) -> float | None:
    """Give the mean FLIP error, if the package `flip-evaluator` is there."""
    try:
        import flip_evaluator
    except ImportError:
        return None
    return float(flip_evaluator.evaluate(reference, picture, "LDR")[1])


def save(shown: np.ndarray, path: Path) -> None:
    """Write a picture in 256 colors, which is a third of its size."""
    path.parent.mkdir(exist_ok=True, parents=True)
    picture = Image.fromarray(np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8))
    picture.quantize(256, dither=Image.Dither.FLOYDSTEINBERG).save(path, optimize=True)
    print(f"written: {path}")
