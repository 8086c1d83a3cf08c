"""By what a layer's gathered light is divided: the ways out that the surface around offers it."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

_SLACK = 1e-5
_NOTHING = (
    1e-12  # of the light: what is left for the widest layers, when their odds are not asked for
)
_ROUNDING = 0.05  # of a flat sheet's exits: below this excess the gain rises from 1 quadratically


class AbstractNormalization(eqx.Module):
    r"""How light is shared where a body is thin or curved. A layer is the mean over the splats
    around, times a gain:

        L_k(x) = gain_k(x) sum_j A_j G(v_k, |x - q_j|) E_j / sum_j A_j G(v_k, |x - q_j|),   q_j =
        p_j - depth_k n_j

    **Attributes:**

    - `depth`: how far below its splat the source of a layer lies, in standard deviations of the
      layer. Static.
    """

    depth: eqx.AbstractVar[float]

    def depths(self, variances: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
        """Give how far below its splat the source of each layer lies, mm."""
        return self.depth * jnp.sqrt(variances)

    @abc.abstractmethod
    def gain(
        self,
        exits: Float[Array, "gaussians #channels *points"],
        variances: Float[Array, " gaussians"],
        energies: Float[Array, "gaussians channels *points"],
        once: Float[Array, "channels *points"],
    ) -> Float[Array, "gaussians #channels *points"]:
        r"""Give by how much each layer passes the mean over the splats around.

        **Arguments:**

        - `exits`: `sum_j A_j G(v_k, |x - q_j|)` over what it is on a flat sheet: 1 there, 2 in a
          sheet much thinner than the layer is wide, less at open edges.
        - `variances`: mm^2; only their order counts.
        - `energies`: weights times the albedo there: the share of the light that leaves a flat
          piece as each layer.
        - `once`: the share that leaves as single scattering.
        """


class PlainMean(AbstractNormalization):
    """The paper's: the mean over the splats around, as they lie. Constants are kept whatever the
    shape.
    """

    depth: float = eqx.field(static=True, default=0.0)

    def gain(self, exits, variances, energies, once):
        return jnp.ones_like(exits)


class ExitOdds(AbstractNormalization):
    r"""Light leaves a thin or convex part sooner, so less of it is absorbed: twice the ways out,
    twice the odds of leaving.

    Light spreads from layer to layer, the narrow ones first. Of what is still inside, the share
    `p_k = w_k / (W_k + 1 - W)` leaves a flat surface as layer k, where `W_k` is the energy of the
    layers as wide or wider and `W` that of all and of single scattering, each times the albedo.
    With `S_k` exits for one the odds `p_k / (1 - p_k)` grow S_k-fold, and the wider layers have
    what is left:

        gain_k = S_k / prod_(j <= k) (1 + p_j (S_j - 1))    where S > 1; S counts as 1 elsewhere

    On flat pieces and at open edges the gain is 1. Of weights that are not negative and sum to one
    or less never more leaves than came, `sum_k w_k gain_k <= 1`, and from what absorbs nothing (`W
    = 1`) all of it. Negative weights, as a free fit may have, count as none. The corner at `S = 1`
    is rounded over 0.05.

    The source lies below its splat, since the light that leaves has been inside: what faces away is
    nearer through a thin part, and what lies across a gap of air is farther.

    **Source:** fitted to path tracing: docs/bodies.md.
    """

    depth: float = eqx.field(static=True, default=0.75)

    def gain(self, exits, variances, energies, once):
        energies = jnp.where(energies >= 0, energies, 0.0)
        absorbed = 1 - jnp.sum(energies, axis=0) - once
        absorbed = jnp.where(absorbed >= -_SLACK, absorbed, 0.0)[
            None
        ]  # white is white to rounding: not at a corner
        rank = jnp.argsort(jnp.argsort(variances))
        upto = (rank[None] <= rank[:, None]).astype(
            exits.dtype
        )  # of row k: the layers that are not wider
        inside = jnp.tensordot(upto.T, energies, 1) + absorbed
        leaving = energies / jnp.where(inside > _NOTHING, inside, 1.0)
        more = jnp.maximum(exits - 1, 0)
        more = more * more / (more + _ROUNDING)
        return (1 + more) * jnp.exp(-jnp.tensordot(upto, jnp.log(1 + leaving * more), 1))
