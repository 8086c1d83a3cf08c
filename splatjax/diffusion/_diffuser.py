"""What a diffuser does, whichever way: the diffusion integral of every layer at surface points
(pass 4, section 4.2).
"""

import abc
from collections.abc import Sequence

import equinox as eqx
import jax
from jaxtyping import Array, Bool, Float

from splatjax.scene import Splats
from splatjax.splatting import Atlas

from ._normalization import AbstractNormalization


class Sources(eqx.Module):
    """The splats as sources of diffused light."""

    centers: Float[Array, "3 splats"]
    normals: Float[Array, "3 splats"]
    areas: Float[Array, " splats"]
    irradiance: Float[Array, "channels splats"]


class Kernels(eqx.Module):
    """How the layers spread light: variances (mm^2), and how far below its splat each layer's
    source lies (mm).
    """

    variances: Float[Array, " gaussians"]
    depths: Float[Array, " gaussians"]

    @classmethod
    def of(
        cls, variances: Float[Array, " gaussians"], normalization: AbstractNormalization
    ) -> "Kernels":
        """Give the kernels of layers as a normalization places their sources."""
        return cls(variances, normalization.depths(variances))


class Diffused(eqx.Module):
    """The diffusion integrals, and what capacity they needed over what was planned."""

    means: Float[Array, "tiles gaussians channels points"]
    exits: Float[Array, "tiles gaussians points"]
    carried: Float[Array, " gaussians"]
    """1, or 0 for a layer that was not evaluated, being too narrow for nearly all splats."""
    needed: Float[Array, ""]


class AbstractDiffuser(eqx.Module):
    r"""The diffusion integral at surface points `x`, over all splats near `x` in object space,
    whichever way they face:

        mean_k(x) = sum_j A_j G(v_k, |x - q_j|) E_j / sum_j A_j G(v_k, |x - q_j|),   q_j = p_j -
        depth_k n_j

    The mean keeps constants, lies between the least and the greatest E, and is linear in E. `exits`
    is the denominator over what it is on a flat sheet, `exp(-depth_k^2 / 2 v_k)`.
    """

    @abc.abstractmethod
    def planned(
        self,
        splats: Splats,
        kernels: Kernels,
        interval: Float[Array, "2"],
        atlases: Sequence[Atlas],
    ) -> "AbstractDiffuser":
        """Give a diffuser with room for these splats, kernels and pictures; `interval` tells which
        layers are handed over.
        """

    @abc.abstractmethod
    def diffuse(
        self,
        sources: Sources,
        kernels: Kernels,
        points: Float[Array, "tiles 3 points"],
        covered: Bool[Array, "tiles points"],
        atlas: Atlas,
    ) -> Diffused:
        """Evaluate every layer at the covered points that the tiles of an atlas show; 0
        elsewhere.
        """

    @abc.abstractmethod
    def in_forward_mode(self) -> "AbstractDiffuser":
        """Give a diffuser of the same values that has forward mode in the kernels; it may have no
        reverse mode.
        """


def diffuse_with_slopes(
    diffuser: AbstractDiffuser,
    sources: Sources,
    variances: Float[Array, " gaussians"],
    normalization: AbstractNormalization,
    points: Float[Array, "tiles 3 points"],
    covered: Bool[Array, "tiles points"],
    atlas: Atlas,
    direction: Float[Array, " gaussians"],
) -> tuple[Diffused, Diffused]:
    """Diffuse, and differentiate in the variances: each layer gathers by its own alone, so one
    direction holds them all.

    **Arguments:** as in `AbstractDiffuser.diffuse`.

    - `direction`: by how much each variance moves, mm^2.

    **Returns:** the integrals, and what each does per unit of `direction`.
    """
    forward = diffuser.in_forward_mode()

    def diffuse(variances):
        return forward.diffuse(
            sources, Kernels.of(variances, normalization), points, covered, atlas
        )

    return jax.jvp(diffuse, (variances,), (direction,))
