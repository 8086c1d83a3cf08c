"""Which channels share their variances."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from splatjax.gaussians import AbstractProfile
from splatjax.scattering import AbstractRadialRule

from ._problem import Problem, make_problem
from ._search import AbstractStart
from ._weights import AbstractWeights


class AbstractSpread(eqx.Module):
    """Which channels of a fit share their variances: the problem of a profile is one, or one for
    each channel.
    """

    @abc.abstractmethod
    def problem(
        self, profile: AbstractProfile, weights: AbstractWeights, rule: AbstractRadialRule
    ) -> Problem:
        """State what is to be fitted, with a leading axis if there is more than one problem."""

    @abc.abstractmethod
    def over(
        self,
        function: Callable[[Problem, AbstractStart], Any],
        problem: Problem,
        start: AbstractStart,
    ) -> Any:
        """Give what a function of one problem and its start gives for each: with a leading axis, if
        `problem` has one.
        """


class SharedVariances(AbstractSpread):
    r"""One set of variances for all channels, as the renderer needs it: it draws one layer for
    each.

    The fit minimizes the sum over the channels of the square of Eq. 4.
    """

    def problem(
        self, profile: AbstractProfile, weights: AbstractWeights, rule: AbstractRadialRule
    ) -> Problem:
        return make_problem(profile, weights, rule)

    def over(
        self,
        function: Callable[[Problem, AbstractStart], Any],
        problem: Problem,
        start: AbstractStart,
    ) -> Any:
        return function(problem, start)


class VariancesPerChannel(AbstractSpread):
    """Variances of its own for each channel: one `SumOfGaussians` of one channel for each, batched
    along a leading axis.
    """

    def problem(
        self, profile: AbstractProfile, weights: AbstractWeights, rule: AbstractRadialRule
    ) -> Problem:
        shared = make_problem(profile, weights, rule)
        fields = (
            shared.squared_radii,
            shared.root_weights,
            shared.target,
            shared.norm,
            shared.total,
        )
        unit = jax.lax.stop_gradient(profile.length_scale())
        return Problem(*(field[:, None] for field in fields), unit=unit, weights=weights)

    def over(
        self,
        function: Callable[[Problem, AbstractStart], Any],
        problem: Problem,
        start: AbstractStart,
    ) -> Any:
        return jax.vmap(function)(problem, start.of_channels(problem.unit.shape[0]))
