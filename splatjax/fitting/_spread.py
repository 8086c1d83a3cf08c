"""Which channels share their variances."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from ._problem import FitProblem
from ._search import AbstractStart


class AbstractSpread(eqx.Module):
    """Which channels of a fit share their variances, and hence form one problem."""

    @abc.abstractmethod
    def over(
        self,
        function: Callable[[FitProblem, AbstractStart], Any],
        problem: FitProblem,
        start: AbstractStart,
    ) -> Any:
        """Apply a function to each problem and its start; with a leading axis where there are
        several.
        """


class SharedVariances(AbstractSpread):
    r"""One set of variances for all channels, as the renderer needs it: it draws one layer for
    each.

    The fit minimizes the sum over the channels of the square of Eq. 4.
    """

    def over(self, function, problem, start):
        return function(problem, start)


class VariancesPerChannel(AbstractSpread):
    """Separate variances for each channel: one `SumOfGaussians` of one channel for each, batched
    along a leading axis.
    """

    def over(self, function, problem, start):
        channels = jax.tree.map(lambda values: values[:, None], problem)
        return jax.vmap(function)(channels, start.of_channels(problem.norm.shape[0]))
