"""Deferred shading: the light is found at what the pixels see, by the normal there."""

import jax.numpy as jnp
import numpy as np
import scipy  # its parts are loaded where they are used, which takes a third of a second
from jaxtyping import Array, Float

from splatjax._chunking import map_chunks
from splatjax.geometry import tangent_frames
from splatjax.render import AbstractLighting, LightOnSplats, entering_light, surface_attributes
from splatjax.scene import Scene, Splats, StackedLights
from splatjax.shading import unit_normals
from splatjax.splatting import TILES_AT_ONCE

_NEIGHBORS = 12
_LEAST_SPREAD = 1e-3  # of the neighbors' mean squared distance: below it a direction has no slope


class LightAtPixels(AbstractLighting):
    """Blends normals and all else that splats carry, and lights each pixel by what was blended.

    **Source:** Botsch et al. 2005, "High-Quality Surface Splatting on Today's GPUs", section 4; so
    did Zwicker et al. 2001.
    """

    def at_pixels(self, scene, groups, points, named):
        def lit(points, named):
            return _lit(scene, groups, points, named)

        return map_chunks(lit, points, named, at_once=TILES_AT_ONCE)


class NormalFields(LightAtPixels):
    r"""Lights each pixel by normals that vary within a splat: `n_i + slopes_i (x - p_i)`, not unit.

    The fields of a pixel's splats are blended, then shaded; the originals were shaded, then
    blended, which is the same to second order in how much they disagree there.

    **Attributes:**

    - `slopes`: how the normal of each splat turns, 1/mm; from `normal_slopes`, or of the surface's
      curvature. Differentiable.

    **Source:** Botsch et al. 2004, "Phong Splatting".
    """

    slopes: Float[Array, "splats 3 3"]

    def attributes(self, scene, light, entering):
        splats, slopes = scene.splats, self.slopes.astype(scene.splats.centers.dtype)
        at_origin = splats.normals - jnp.einsum("sij,sj->si", slopes, splats.centers)
        return surface_attributes(scene, light, entering) | {
            "normal": at_origin.T,
            "normal slopes": slopes.reshape(splats.count, 9).T,
        }

    def at_pixels(self, scene, groups, points, named):
        rows = dict(named)
        slopes = rows.pop("normal slopes")
        slopes = slopes.reshape(slopes.shape[0], 3, 3, slopes.shape[2])
        normal = rows["normal"] + jnp.einsum("tijp,tjp->tip", slopes, points)
        return super().at_pixels(scene, groups, points, rows | {"normal": normal})


def normal_slopes(splats: Splats, neighbors: int = _NEIGHBORS) -> Float[Array, "splats 3 3"]:
    r"""Give how normals turn around each splat, by least squares over its neighbors in the plane of
    the splat, 1/mm.

    **Arguments:**

    - `splats`: concrete, not traced; at least 4.
    - `neighbors`: how many; those that face the other way, beyond a thin part, do not count.

    **Returns:** zero along the splat's own normal, and where the neighbors lie in one line, across
    it.
    """
    centers, normals = (np.asarray(rows, float) for rows in (splats.centers, splats.normals))
    near = scipy.spatial.KDTree(centers).query(centers, k=min(neighbors + 1, len(centers)))[1][
        :, 1:
    ]
    plane = np.stack(tangent_frames(normals), axis=1)
    counts = np.einsum("ski,si->sk", normals[near], normals) > 0
    offsets = np.einsum("ski,sai->ska", centers[near] - centers[:, None], plane) * counts[..., None]
    turns = normals[near] - normals[:, None]
    spread = np.einsum("ska,skb->sab", offsets, offsets)
    spread += _LEAST_SPREAD * np.trace(spread, axis1=1, axis2=2)[:, None, None] * np.eye(
        2
    ) + np.finfo(float).tiny * np.eye(2)
    slopes = np.einsum("ska,ski->sai", offsets, turns)
    in_space = np.einsum("sai,saj->sij", np.linalg.solve(spread, slopes), plane)
    return jnp.asarray(in_space, splats.centers.dtype)


def _lit(
    scene: Scene,
    groups: list[StackedLights],
    points: Float[Array, "tiles 3 pixels"],
    named: dict[str, Float[Array, "tiles _rows pixels"]],
) -> dict[str, Float[Array, "tiles _rows pixels"]]:
    material, tiles = scene.material, points.shape[0]

    def flat(rows: Float[Array, "tiles rows pixels"]) -> Float[Array, "points rows"]:
        return rows.transpose(0, 2, 1).reshape(-1, rows.shape[1])

    def tiled(rows: Float[Array, "rows points"]) -> Float[Array, "tiles rows pixels"]:
        return rows.reshape(rows.shape[0], tiles, -1).transpose(1, 0, 2)

    shares = [
        flat(lit).T if (lit := named.get(f"lit {i}")) is not None else None
        for i in range(len(groups))
    ]
    light = LightOnSplats(groups, shares, jnp.zeros((), points.dtype))
    specular = flat(named["specular"])[:, 0] if "specular" in named else material.specular
    roughness = flat(named["roughness"])[:, 0] if "roughness" in named else material.roughness
    albedo = flat(named["albedo"]) if "albedo" in named else None
    normals = unit_normals(flat(named["normal"]))
    entering = entering_light(material, light, flat(points), normals, albedo, specular, roughness)
    lit = named | {"source": tiled(entering.source)}
    return lit | {"irradiance": tiled(entering.irradiance)} if "irradiance" in named else lit
