"""How the weights of a fit are found when the variances are given."""

import abc

import equinox as eqx
from jaxtyping import Array, Float

from ._dense import least_squares, normal_inverse


class AbstractWeights(eqx.Module):
    """The weights that a fit may choose from: a set that does not depend on the variances."""

    @abc.abstractmethod
    def solve(
        self,
        basis: Float[Array, "rows gaussians"],
        target: Float[Array, " rows"],
        energies: Float[Array, " gaussians"],
        total: Float[Array, ""],
    ) -> Float[Array, " gaussians"]:
        """Give the coefficients in the set with the least `|target - basis @ coefficients|`.

        **Arguments:** (all differentiable)

        - `basis`: scaled Gaussians at the roots of the quadrature's weights, of full column rank.
        - `target`: the profile there.
        - `energies`: weight of a unit coefficient; `energies @ coefficients` is the energy of the sum.
        - `total`: the energy of the profile.
        """


class FreeWeights(AbstractWeights):
    """Any weights: the least error of Eq. 3. Their sum may miss the profile's total reflectance by some per cent."""

    def solve(
        self,
        basis: Float[Array, "rows gaussians"],
        target: Float[Array, " rows"],
        energies: Float[Array, " gaussians"],
        total: Float[Array, ""],
    ) -> Float[Array, " gaussians"]:
        del energies, total
        return least_squares(basis, target, normal_inverse(basis))


class TotalReflectanceHeld(AbstractWeights):
    """Weights whose sum is the profile's total reflectance: the picture keeps its energy, at a somewhat larger error."""

    def solve(
        self,
        basis: Float[Array, "rows gaussians"],
        target: Float[Array, " rows"],
        energies: Float[Array, " gaussians"],
        total: Float[Array, ""],
    ) -> Float[Array, " gaussians"]:
        inverse = normal_inverse(basis)
        free = least_squares(basis, target, inverse)
        # The way from the free optimum to the constraint that adds least to the error.
        direction = inverse @ energies
        return free + direction * ((total - energies @ free) / (energies @ direction))
