"""Pass 5: shade the surface samples, and compose them to a frame."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatjax import diffusion as _diffusion, shading as _shading, splatting as _splatting
from splatjax.scene import Frame, Scene, StackedLights

from ._attributes import SurfaceAttributes, SurfaceSamples
from ._settings import RenderSettings


class ShadedSurface(eqx.Module):
    """The surface samples, shaded; nothing is premultiplied.

    **Attributes:**

    - `radiance_per_exitance`: towards the eye, `sqrt(albedo) exit_transmission / pi`; 0 without a
      surface.
    - `layers`: of each Gaussian, times `radiance_per_exitance`.
    - `diffuse`: their weighted sum.
    - `resolved`: the fraction of each layer that is the diffusion integral.
    """

    depth: Float[Array, " points"]
    positions: Float[Array, "3 points"]
    normals: Float[Array, "3 points"]
    albedo: Float[Array, "channels points"]
    shadow: Float[Array, "lights points"]
    irradiance: Float[Array, "channels points"]
    radiance_per_exitance: Float[Array, "#channels points"]
    layers: Float[Array, "gaussians channels points"]
    diffuse: Float[Array, "channels points"]
    specular: Float[Array, "channels points"]
    single_scattering: Float[Array, "channels points"] | None
    resolved: Float[Array, "gaussians points"]


def layers_at_points(
    scene: Scene,
    samples: SurfaceSamples,
    attributes: SurfaceAttributes,
    source: Float[Array, "channels points"],
    gaussians: Int[Array, " layers"],
    interval: Float[Array, "2"],
    kernel: _diffusion.AbstractDiffusionKernel,
) -> _diffusion.LayersAtPoints:
    """Collect the inputs of the layers of the samples.

    **Arguments:**

    - `source`: the surface's own irradiance, for layers that the splats do not resolve; the layers
      of the samples begin with its channels.
    - `gaussians`: of the layers, as in a plan.
    """
    albedo = attributes.albedo
    return _diffusion.LayersAtPoints.of(
        scene.material.gaussians.variances,
        gaussians,
        samples.layers,
        samples.derivative,
        source,
        jnp.where(samples.covered, attributes.area[0], 1.0),
        jnp.ones_like(source) if albedo is None else albedo,
        interval,
        kernel,
        attributes.weights,
    )


def shade(
    scene: Scene,
    eye: Float[Array, "3"],
    groups: list[StackedLights],
    samples: SurfaceSamples,
    gaussians: Int[Array, " layers"],
    interval: Float[Array, "2"],
    settings: RenderSettings,
) -> tuple[ShadedSurface, _diffusion.LayersAtPoints]:
    """Shade the samples: the layers, the specular lobe, and single scattering. Also return the
    inputs of the layers.

    **Arguments:**

    - `gaussians`, `interval`: of the layers, as in a plan.
    """
    material, covered = scene.material, samples.covered
    attributes = settings.lighting.at_pixels(scene, groups, samples)
    f0 = _shading.fresnel_f0(material.eta)
    to_eye = eye[:, None] - samples.positions
    points = _shading.SurfacePoints(
        positions=samples.positions.T,
        normals=_shading.unit_normals(attributes.normals.T),
        outgoing=(to_eye / jnp.sqrt(jnp.sum(to_eye * to_eye, axis=0, keepdims=True))).T,
        specular=material.specular if attributes.specular is None else attributes.specular[0],
        roughness=material.roughness if attributes.roughness is None else attributes.roughness[0],
        visibility=[
            None if rows is None else group.per_sample(rows)
            for group, rows in zip(groups, attributes.visibility, strict=True)
        ],
    )
    of_layers = attributes.source, gaussians, interval, settings.kernel
    at = layers_at_points(scene, samples, attributes, *of_layers)
    albedo = at.albedo
    per_exitance = _shading.exit_transmission(points, f0, material.angular_law()) / jnp.pi
    if attributes.albedo is not None:
        per_exitance = per_exitance * _shading.albedo_root(albedo)
    single = None
    if attributes.single_scattering is not None:
        single = jnp.where(covered[None], attributes.single_scattering, 0.0)
        if attributes.albedo is not None:
            single = single * _shading.albedo_root(albedo) ** 2
    layers, resolved = at.weigh(material.gaussians, material.single_scattering_albedo())
    layers = jnp.where(covered[None, None], per_exitance[None] * layers, 0.0)
    specular = _shading.reflected_radiance(points, groups, f0, material.channels)
    shadow = _shadows_in_order(attributes.visibility, groups, len(scene.lights), samples.depth)
    shaded = ShadedSurface(
        depth=jnp.where(covered, samples.depth, jnp.inf),
        positions=jnp.where(covered[None], samples.positions, 0.0),
        normals=points.normals.T,
        albedo=albedo,
        shadow=jnp.where(covered[None], shadow, 1.0),
        irradiance=attributes.source if attributes.irradiance is None else attributes.irradiance,
        radiance_per_exitance=jnp.where(covered[None], per_exitance, 0.0),
        layers=layers,
        diffuse=jnp.sum(material.gaussians.weights[:, :, None] * layers, axis=0),
        specular=jnp.where(covered[None], specular, 0.0),
        single_scattering=single,
        resolved=resolved,
    )
    return shaded, at


def compose(
    scene: Scene,
    shaded: ShadedSurface,
    visible: _splatting.VisibleSurfaces,
) -> Frame:
    """Composite the front surface over the one behind it; all values are NaN if the plan does not
    suffice.

    **Arguments:**

    - `shaded`: with arrays `[places, *rows, pixels]`.
    """
    front, picture = visible.front_picture, visible.picture
    diffuse, specular = picture(shaded.diffuse), picture(shaded.specular)
    single = None if shaded.single_scattering is None else picture(shaded.single_scattering)
    invalid = _splatting.invalid_factor(visible.needed)
    drawn = ((visible.share > 0) & visible.in_front[:, None]).astype(invalid.dtype)
    unresolved = jnp.sum((1 - shaded.resolved) * drawn[:, None], axis=(0, 2))
    return Frame(
        beauty=diffuse + specular if single is None else diffuse + single + specular,
        coverage=picture(jnp.ones_like(shaded.depth)),
        depth=front(shaded.depth, jnp.inf),
        position=front(shaded.positions),
        normal=front(shaded.normals),
        albedo=picture(shaded.albedo),
        shadow=jnp.moveaxis(front(shaded.shadow, 1.0), -1, 0),
        irradiance=picture(shaded.irradiance),
        layers=jnp.moveaxis(picture(shaded.layers), 2, 0),
        weights=scene.material.gaussians.weights,
        diffuse=diffuse,
        specular=specular,
        unresolved_fraction=invalid * unresolved / jnp.maximum(jnp.sum(drawn), 1),
        overflow=visible.overflow,
        single_scattering=single,
    )


def _shadows_in_order(
    visibility, groups: list[StackedLights], lights: int, depth: Float[Array, " points"]
) -> Float[Array, "lights points"]:
    """Sort the visibility of the lights in the scene's order; 1 if a light casts no shadows."""
    planes = [jnp.ones_like(depth)] * lights
    for group, rows in zip(groups, visibility, strict=True):
        if rows is not None:
            for index, row in zip(group.distinct, rows, strict=True):
                planes[index] = row
    return jnp.stack(planes) if planes else jnp.zeros((0, *depth.shape), depth.dtype)
