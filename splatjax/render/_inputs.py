"""What every picture asks of its inputs: one precision, one number of channels."""

import equinox as eqx
import jax

from splatjax.scene import Scene

SAME = "give both the same number"


def in_one_dtype(scene: Scene, *rest):
    """Cast every float to the dtype of the splats' centers, once."""
    dtype = scene.splats.centers.dtype

    def cast(leaf):
        return leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf

    return jax.tree.map(cast, (scene, *rest))


def check_channels(scene: Scene) -> None:
    """All that carries color must have as many channels as the material's weights."""
    channels = scene.material.gaussians.weights.shape[1]
    found = {}
    if scene.splats.albedo is not None:
        found["splats.albedo"] = scene.splats.albedo.shape[1]
    if scene.material.single_scattering is not None:
        found["material.single_scattering.medium"] = (
            scene.material.single_scattering.medium.sigma_a.shape[0]
        )
    point = jax.ShapeDtypeStruct((1, 3), scene.splats.centers.dtype)
    for i, light in enumerate(scene.lights):
        for sample in light.samples():
            found[f"lights[{i}]"] = eqx.filter_eval_shape(
                lambda sample, x: sample.incidence(x)[1], sample, point
            ).shape[1]
    for name, count in found.items():
        if count != channels:
            raise ValueError(
                f"{name} has {count} channels, material.gaussians.weights has {channels}: {SAME}"
            )
