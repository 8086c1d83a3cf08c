"""The visible surface: its attributes, which passes 2 and 3 blend; and pass 5, which shades samples
of it and composes them to a frame.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree, Shaped

from splatjax import diffusion as _diffusion, shading as _shading, splatting as _splatting
from splatjax._chunking import Result, map_chunks
from splatjax.scene import Frame, Material, Scene, Splats, StackedLights

_NO_AREA = 1e-6  # mm^2, of splats without area


def surface_parameters(
    material: Material, splats: Splats
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Multiply the material's specular strength and roughness with the splats' own."""
    specular = material.specular if splats.specular is None else material.specular * splats.specular
    factor = splats.roughness
    return specular, material.roughness if factor is None else material.roughness * factor


class SurfaceAttributes(eqx.Module):
    """Attributes that passes 2 and 3 blend (Eq. 1). The last axis of every array runs along the
    splats, or along the visible points.

    **Attributes:**

    - `normals`: normals of the splats; blended normals are not of unit length.
    - `area`: per splat, mm^2.
    - `source`: irradiance that spreads below the surface.
    - `albedo`, `irradiance`, `specular`, `roughness`: `None` if the splats have none; `irradiance`
      is then `source`.
    - `weights`: factors on the weights of the material; `None` if the splats have none.
    - `visibility`: for each group of samples the visibility of each light; `None` for lights that
      cast no shadows.
    - `single_scattering`: radiance towards the eye, without the albedo; `None` if the material has
      none.
    - `added_source`: the derivative of `source` with respect to a weight of the Gaussians, if it is
      not zero.
    - `extra`: attributes of another `AbstractLighting`.
    """

    normals: Float[Array, "3 points"]
    area: Float[Array, "1 points"]
    source: Float[Array, "channels points"]
    albedo: Float[Array, "channels points"] | None
    irradiance: Float[Array, "channels points"] | None
    specular: Float[Array, "1 points"] | None
    roughness: Float[Array, "1 points"] | None
    visibility: tuple[Float[Array, "_lights points"] | None, ...]
    single_scattering: Float[Array, "channels points"] | None = None
    weights: Float[Array, "gaussians channels points"] | None = None
    added_source: Float[Array, "channels points"] | None = None
    extra: Any = None


class SurfaceSamples(eqx.Module):
    """The visible surface in the pixels of some tiles, along the last axis.

    **Attributes:**

    - `attributes`: the blended attributes.
    - `positions`: mm.
    - `depth`: mm along the camera's forward axis.
    - `covered`: whether a surface is visible.
    - `layers`: means and mass at the positions; none before they are computed.
    - `derivative`: derivative of the layers with respect to the logarithms of their variances;
      `None` if not requested.
    """

    attributes: SurfaceAttributes
    positions: Float[Array, "3 points"]
    depth: Float[Array, " points"]
    covered: Bool[Array, " points"]
    layers: Float[Array, "layers values points"]
    derivative: Float[Array, "layers values points"] | None


class ShadedSurface(eqx.Module):
    """The shaded surface samples, not premultiplied by coverage.

    **Attributes:**

    - `radiance_per_exitance`: `sqrt(albedo) exit_transmission / pi`, towards the eye; 0 without a
      surface.
    - `layers`: the layer of each Gaussian, times `radiance_per_exitance`.
    - `diffuse`: the weighted sum of the layers.
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
    albedo, (area,) = attributes.albedo, attributes.area
    return _diffusion.LayersAtPoints.of(
        scene.material.gaussians.variances,
        gaussians,
        samples.layers,
        samples.derivative,
        source,
        jnp.where(samples.covered & (area > 0), area, _NO_AREA),
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
    attributes: SurfaceAttributes,
    gaussians: Int[Array, " layers"],
    interval: Float[Array, "2"],
    kernel: _diffusion.AbstractDiffusionKernel,
) -> tuple[ShadedSurface, _diffusion.LayersAtPoints]:
    """Shade the samples: the layers, the specular lobe, and single scattering. Also return the
    inputs of the layers.

    **Arguments:**

    - `attributes`: from `AbstractLighting.at_pixels`.
    - `gaussians`, `interval`: of the layers, as in a plan.
    """
    material, covered = scene.material, samples.covered
    f0 = _shading.fresnel_f0(material.eta)
    points = _shading.SurfacePoints(
        positions=samples.positions.T,
        normals=_shading.unit_normals(attributes.normals.T),
        outgoing=_shading.unit_normals((eye[:, None] - samples.positions).T),
        specular=material.specular if attributes.specular is None else attributes.specular[0],
        roughness=material.roughness if attributes.roughness is None else attributes.roughness[0],
        visibility=[
            None if rows is None else group.per_sample(rows)
            for group, rows in zip(groups, attributes.visibility, strict=True)
        ],
    )
    source = attributes.source
    at = layers_at_points(scene, samples, attributes, source, gaussians, interval, kernel)
    root = _shading.albedo_root(at.albedo)
    per_exitance = root * _shading.exit_transmission(points, f0, material.angular_law()) / jnp.pi
    per_exitance = jnp.where(covered[None], per_exitance, 0.0)
    single = attributes.single_scattering
    if single is not None:
        single = jnp.where(covered[None], root**2 * single, 0.0)
    layers, resolved = at.weigh(material.gaussians, material.single_scattering_albedo())
    layers = per_exitance[None] * layers
    specular = _shading.reflected_radiance(points, groups, f0, material.channels)
    shadow = _shadows_in_order(attributes.visibility, groups, len(scene.lights), samples.depth)
    shaded = ShadedSurface(
        depth=jnp.where(covered, samples.depth, jnp.inf),
        positions=jnp.where(covered[None], samples.positions, 0.0),
        normals=points.normals.T,
        albedo=at.albedo,
        shadow=jnp.where(covered[None], shadow, 1.0),
        irradiance=source if attributes.irradiance is None else attributes.irradiance,
        radiance_per_exitance=per_exitance,
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


def map_places(function: Callable[..., Result], *arrays: PyTree) -> Result:
    """Apply a pointwise function to chunks of places.

    **Arguments:**

    - `function`: takes and returns arrays `[*rows, points]`, the pixels of its places in a row.
    - `arrays`: `[places, *rows, pixels]`.

    **Returns:** the results, `[places, *rows, pixels]`.
    """

    def by_place(values: Shaped[Array, "*rows points"]) -> Shaped[Array, "places *rows pixels"]:
        pixels = _splatting.TILE_SIDE**2
        rows = values.reshape(*values.shape[:-1], values.shape[-1] // pixels, pixels)
        return jnp.moveaxis(rows, -2, 0)

    return map_chunks(
        lambda *chunks: jax.tree.map(by_place, function(*jax.tree.map(in_a_row, chunks))),
        *arrays,
        at_once=_splatting.TILES_AT_ONCE,
    )


def in_a_row(values: Shaped[Array, "places *rows pixels"]) -> Shaped[Array, "*rows points"]:
    rows = jnp.moveaxis(values, 0, -2)
    return rows.reshape(*rows.shape[:-2], rows.shape[-2] * rows.shape[-1])
