"""A finished picture with all its layers."""

import equinox as eqx
from jaxtyping import Array, Float


class Frame(eqx.Module):
    r"""A picture, linear light, row 0 at the top.

    `beauty`, `diffuse`, `specular`, `layers`, `albedo` and `irradiance` are premultiplied by
    coverage; `depth`, `position` and `normal` are those of the front surface and are not. `diffuse
    = sum_k weights_k layers_k` everywhere.

    **Attributes:**

    - `beauty`: `diffuse + specular`, and `single_scattering` where there is one; radiance.
    - `coverage`: in [0, 1].
    - `depth`: along the camera's forward axis, mm; inf where there is nothing.
    - `position`: world space, mm; 0 where there is nothing.
    - `normal`: world space, unit; 0 where there is nothing.
    - `albedo`: of the splats; 1 where they carry none.
    - `shadow`: per light, 1 lit and 0 in shadow, not premultiplied; 1 where there is nothing.
    - `irradiance`: that enters the surface: cosine, shadow and the loss to the specular lobe
      included.
    - `layers`: one per Gaussian, `post * transmission / pi * L_k`.
    - `weights`: those the picture was made with.
    - `diffuse`, `specular`: radiance.
    - `unresolved_fraction`: per Gaussian, the fraction of the covered pixels for which the splats
      are too far apart to resolve the layer, so that it is the surface's own irradiance.
    - `single_scattering`: radiance, premultiplied; `None` when the material has none.
    - `overflow`: what the plan lacks: 0 when the picture fits, else the largest of needed over
      planned, and the picture is NaN.
    """

    beauty: Float[Array, "height width channels"]
    coverage: Float[Array, "height width"]
    depth: Float[Array, "height width"]
    position: Float[Array, "height width 3"]
    normal: Float[Array, "height width 3"]
    albedo: Float[Array, "height width channels"]
    shadow: Float[Array, "lights height width"]
    irradiance: Float[Array, "height width channels"]
    layers: Float[Array, "gaussians height width channels"]
    weights: Float[Array, "gaussians channels"]
    diffuse: Float[Array, "height width channels"]
    specular: Float[Array, "height width channels"]
    unresolved_fraction: Float[Array, " gaussians"]
    overflow: Float[Array, ""]
    single_scattering: Float[Array, "height width channels"] | None = None
